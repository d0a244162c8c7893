"""What a page shows of a run, as JSON: joint states, the status, the plan, and samples of topics."""

from __future__ import annotations

import json
import logging
import math
import re
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, override

import attrs
import numpy as np
from ibrobot_terminal.agent_calls import AgentCalls
from ibrobot_terminal.authority import authority_of

from ibrobot_core.api import NS_PER_S, JointState, Message, String, Vector
from ibrobot_core.app import ControlState, RunView, error_text
from ibrobot_web.messages import SERVICES
from ibrobot_web.modes import modes_json, page_devices
from ibrobot_web.teleop import JOG

_TOKEN = re.compile(r"(?<=[?&]token=)[\w-]+")
_LOG_LINES = 100
_PLAN_ROWS = 24
"""Setpoints of the plan that a page gets, evenly spaced."""
_LEAVES = 64
"""Most numbers of a message in plots."""
_DIGITS = 5
_NO_VALUES = ("header", "layout")
"""Fields of messages that are not plotted."""
PLAN = "/planning/plan"
"""A service that plans to a goal in words, whose path a page draws."""
_GOAL = 300
"""Longest goal of an agent that a page plans to, in characters."""
EPISODE_STATUS = "/record_episode/status"


def without_tokens(text: str) -> str:
    """A line of output without the tokens in its links, which not every page may see."""
    return _TOKEN.sub("…", text)


class LogLines(logging.Handler):
    """Keeps the last lines of the log, for pages that open later. Thread-safe."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._lines: deque[dict[str, Any]] = deque(maxlen=_LOG_LINES)
        self._number = 0
        self._adding = threading.Lock()

    @override
    def emit(self, record: logging.LogRecord) -> None:
        with self._adding:
            self._number += 1
            line = {"n": self._number, "level": record.levelname.lower(), "time": round(record.created, 3)}
            self._lines.append({**line, "text": without_tokens(record.getMessage())})

    def lines(self) -> list[dict[str, Any]]:
        """The last lines, oldest first."""
        with self._adding:
            return list(self._lines)


def agents_json(session: RunView, calls: AgentCalls) -> dict[str, Any]:
    """The connected agents, what they may do, and what one asked for."""
    status, newest = authority_of(session).status(), calls.newest
    asked = None
    if newest is not None:
        service, request = newest.plan or ("", {})
        goal = request["goal"] if service == PLAN and len(request["goal"]) <= _GOAL else ""
        asked = {
            "agent": newest.agent, "service": newest.service, "request": newest.request, "refused": newest.refused,
            "goal": goal,
        }  # fmt: skip
    return {
        "connected": list(status.agents), "armed": status.armed, "left_s": math.ceil(status.left_s),
        "speed": None if status.grant is None else status.grant.speed, "ended": status.ended, "asked": asked,
    }  # fmt: skip


def state_json(state: ControlState) -> dict[str, Any]:
    """A joint state."""
    return {
        "stamp": state.stamp_ns, "tick": state.tick, "late_us": round(state.late_ns / 1e3, 1), "estop": state.estop,
        "stops": state.stops, "stale": state.stale, "position": _numbers(state.position),
        "command": _numbers(state.command),
    }  # fmt: skip


def robot_json(session: RunView) -> dict[str, Any]:
    """What does not change during a run."""
    config, robot = session.config, session.config.robot
    return {
        "name": robot.name, "simulated": config.simulated, "lockstep": session.request.lockstep,
        "source": config.source.name, "rate_hz": config.control.rate_hz,
        "joints": [{"name": joint.name, "lower": joint.lower, "upper": joint.upper} for joint in robot.joints],
        "groups": {name: list(joints) for name, joints in robot.groups.items()},
        "poses": {name: list(pose) for name, pose in robot.description.poses.items()},
        "tool": robot.description.mjcf is not None,
        "modes": modes_json(config, session.registry, terminal=session.request.keys is not None),
    }  # fmt: skip


def status_json(session: RunView, log: LogLines, agents: AgentCalls, pages: int) -> dict[str, Any]:
    """Everything about a run that changes, except joint states."""
    counts = session.counts()
    conditions = session.conditions
    held = session.held and not session.faults
    return {
        "robot": robot_json(session),
        "mode": session.mode, "jogs": _jogs(session),
        "held": session.to_go_on() if held else "", "guard": _guard(session),
        "faults": [{"text": fault, "remedy": "Remove the cause, then reset."} for fault in session.faults],
        "all_faults": len(session.outcome.faults), "failure": session.failure_text,
        "conditions": [{name: str(value) for name, value in each.items()} for each in conditions],
        "absent": [{"name": each.label, "why": str(each.missing)} for each in session.absent],
        "services": [name for name in SERVICES if session.bus.serves(name)],
        "help": session.command_source.help(), "autonomous": session.command_source.autonomous,
        "sensors": {
            name: {"rate_hz": round(each.rate_hz, 1),
                   "age_ms": None if each.age_s is None else round(each.age_s * 1e3, 1)}
            for name, each in session.sensors.items()
        },
        "counts": {group: {key: _plain(value) for key, value in values.items()} for group, values in counts.items()},
        "episode": episode_json(session),
        "episodes": session.outcome.episodes, "successes": session.outcome.successes,
        "pages": pages, "agents": agents_json(session, agents), "log": log.lines(), "commander": session.commander,
        "panels": _panels(session),
    }  # fmt: skip


def _guard(session: RunView) -> dict[str, Any]:
    """What the guard keeps apart now, by the newest message on `/guard`, and that in words as `text`; else empty."""
    newest = session.bus.latched().get("/guard")
    label = newest.message.data if newest is not None and isinstance(newest.message, String) else ""
    try:
        read = json.loads(label or "{}")
        if read:
            sound = {"sound": True} if read.get("sound") else {}
            read = {**{name: str(read[name]) for name in ("first", "second", "text")}, **sound}
    except (AttributeError, LookupError, TypeError, ValueError):
        read = {"text": label}
    return dict(read)


def episode_json(session: RunView) -> Any:
    """The state of recording; None if nothing records."""
    if not session.bus.serves(EPISODE_STATUS):
        return None
    return _plain(attrs.asdict(session.bus.call(EPISODE_STATUS)))


def _jogs(session: RunView) -> list[str]:
    """The devices with which the page can jog now."""
    mode = session.config.control_modes.get(session.mode)
    if mode is None or not session.bus.serves(JOG):
        return []
    return list(page_devices(session.config, mode).values())


def _panels(session: RunView) -> list[dict[str, Any]]:
    """The tables of plugins; the error of one takes the place of its rows."""
    panels = []
    for panel in session.registry.of_kind("panel"):
        try:
            rows = [[str(cell) for cell in row] for row in panel.make(session)]
        except Exception as error:  # noqa: BLE001 - contained: a plugin's table must not end the run
            rows = [[error_text(error)]]
        if rows:
            panels.append({"title": panel.label, "columns": list(panel.columns), "rows": rows})
    return panels


def plan_json(session: RunView, now_ns: int) -> dict[str, Any]:
    """The part of the plan still to come; without rows if there is none."""
    plan = session.plan
    if plan is None or plan.generation != session.generation or len(plan.positions) < 2:
        return {"joints": [], "rows": []}
    begin = max(0, math.ceil((now_ns - plan.start_ns) / plan.step_ns))
    rows = plan.positions[begin:]
    chosen = np.unique(np.linspace(0, max(0, len(rows) - 1), min(len(rows), _PLAN_ROWS)).astype(int))
    return {
        "joints": np.flatnonzero(plan.mask).tolist(),
        "rows": [_numbers(row[plan.mask]) for row in rows[chosen]],
        "ends_s": round(max(0.0, (plan.start_ns + len(plan.positions) * plan.step_ns - now_ns) / NS_PER_S), 3),
    }


def numbers_of(message: Message, joints: tuple[str, ...] = ()) -> dict[str, float]:
    """The numbers of a message for plots: path -> value; at most `_LEAVES`.

    Args:
        message: the message; the paths of a JointState have the names of its joints.
        joints: the joints of a vector of commands.
    """
    if isinstance(message, JointState):
        joints = message.name
    numbers: dict[str, float] = {}
    for path, value in _leaves(message, ""):
        if len(numbers) >= _LEAVES:
            break
        numbers[_by_name(path, joints)] = value
    return numbers


def _by_name(path: str, joints: tuple[str, ...]) -> str:
    """`position[0]` as `position.shoulder_pan`, and `data[0]` of a command as the joint's name."""
    field, bracket, index = path.partition("[")
    if not bracket or not index[:-1].isdigit() or int(index[:-1]) >= len(joints):
        return path
    name = joints[int(index[:-1])]
    return name if field == "data" else f"{field}.{name}"


def _leaves(value: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float | np.number):
        if math.isfinite(value):
            yield path, round(float(value), _DIGITS)
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "fiu" and value.size <= _LEAVES:
            for i, each in enumerate(value.ravel().tolist()):
                yield from _leaves(each, f"{path}[{i}]")
    elif attrs.has(type(value)):
        for field in attrs.fields(type(value)):
            if field.name not in _NO_VALUES:
                yield from _leaves(getattr(value, field.name), f"{path}.{field.name}" if path else field.name)


def _numbers(vector: Vector) -> list[float | None]:
    """Rounded numbers; None for those that are not finite, which JSON lacks."""
    return [round(value, _DIGITS) if math.isfinite(value) else None for value in vector.tolist()]


def _plain(value: Any) -> Any:
    """A value in JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float | np.floating):
        return round(float(value), 4) if math.isfinite(value) else None
    return str(value)
