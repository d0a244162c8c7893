"""What agents ask for, as viewers show it to the person who may grant it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, seconds
from ibrobot_core.app import RunView, error_text
from ibrobot_terminal.authority import authority_of

_LONGEST = 300
"""Longest request of an agent that is shown, in characters."""
_REASON = 200
"""Longest reason why there is no path, in characters."""
_STILL_RAD = 0.01
"""A joint that moves by less is left out [rad]."""
_JOINTS = 3
"""Most joints that the summary of a path names."""


@attrs.frozen
class AskedPath:
    """A path that an agent asks for."""

    seconds: float
    """How long it takes at full speed; 0 without a path."""
    text: str

    def at(self, speed: float) -> str:
        """It in words, at a fraction of the speed limits."""
        return f"up to {self.seconds / speed:.1f} s; {self.text}" if self.seconds else self.text


@attrs.frozen
class AgentCall:
    """A call of an agent that would move the robot, or has moved it."""

    agent: str
    service: str
    request: str
    """As JSON; of one that is longer than what is shown, the beginning and how much is left out."""
    refused: bool
    plan: tuple[str, Any] | None
    """The service that plans the same without moving, and its request; None where none does."""
    number: int = attrs.field(eq=False)
    """How many calls came before it."""


class AgentCalls:
    """The newest call of an agent that would move the robot, so that a person sees it before granting it.

    Args:
        session: the run.

    Attributes:
        newest: the call; None before the first.
    """

    def __init__(self, session: RunView) -> None:
        self._session, self._authority = session, authority_of(session)
        self._count = 0
        self.newest: AgentCall | None = None
        self._authority.told.append(self._take)

    def close(self) -> None:
        """Listen no more. Safe to call twice."""
        with suppress(ValueError):
            self._authority.told.remove(self._take)

    def _take(self, entry: Mapping[str, Any]) -> None:
        service = self._session.bus.services().get(entry.get("service", ""))
        if service is not None and not (service.reads or service.urgent or service.persons):
            request = str(entry["request"])
            self._count += 1
            self.newest = AgentCall(
                entry["agent"], service.name, _shown(request), entry["event"] == "refused",
                _plan(service.name, request), self._count,
            )  # fmt: skip


def _shown(request: str) -> str:
    """A request as far as it is shown: a person must see what is left out. Spaces in it fill no line."""
    request = " ".join(request.split())
    left = len(request) - _LONGEST
    return request if left <= 0 else f"{request[:_LONGEST]} … and {left} characters more"


def _plan(service: str, request: str) -> tuple[str, Any] | None:
    """The service that plans a request to `service` without moving, and its request."""
    try:
        plain = json.loads(request)
    except (ValueError, RecursionError):  # the log has only the beginning of long ones
        return None
    fields = plain if isinstance(plain, dict) else {}
    match service:
        case "/planning/go_to":
            goal = fields.get("goal") if fields else plain
            return ("/planning/plan", {"goal": goal}) if isinstance(goal, str) else None
        case "/move_action" if fields:
            return "/plan_kinematic_path", fields
        case "/task/step" if isinstance(fields.get("move"), dict):
            return _of_step(fields["move"])
    return None


def _of_step(move: Mapping[str, Any]) -> tuple[str, Any]:
    """What plans a step `move` of a task."""
    scaling = {"velocity_scaling": move["speed"]} if "speed" in move else {}
    if "line" in move:
        more = {key: move[key] for key in ("least_fraction", "path_constraints") if key in move}
        return "/compute_cartesian_path", {"waypoints": move["line"], **more, **scaling}
    goal = {key: value for key, value in move.items() if key not in ("any", "touch", "speed")}
    return "/plan_kinematic_path", {"goals": move.get("any") or [goal], **scaling}


def planned_path(session: RunView, asked: AgentCall) -> AskedPath:
    """The path that an agent asks for; planning it takes up to some seconds."""
    if asked.plan is None:
        return AskedPath(0.0, "known only as it moves")
    try:
        return path_of(session, session.bus.call(*asked.plan))
    except Exception as error:  # noqa: BLE001 - contained: what an agent asks for must not end the run
        return _none(error_text(error))


def _none(why: str) -> AskedPath:
    """No path. The reason may quote the agent: short and in ASCII, it looks like no other row of the panel."""
    words = " ".join(why.split()).encode("ascii", "backslashreplace").decode()
    return AskedPath(0.0, f"none: {words if len(words) <= _REASON else f'{words[:_REASON]} …'}")


def path_of(session: RunView, answer: Any) -> AskedPath:
    """The path in the answer of a service that plans."""
    if answer.trajectory is None:
        return _none(answer.message)
    names, points = answer.trajectory.joint_names, answer.trajectory.points
    begin, end = (dict(zip(names, each.positions.tolist(), strict=True)) for each in (points[0], points[-1]))
    moved = [
        name
        for name in sorted(names, key=lambda name: -abs(end[name] - begin[name]))
        if abs(end[name] - begin[name]) >= _STILL_RAD
    ]
    joints = [f"{name} {begin[name]:.2f} to {end[name]:.2f}" for name in moved[:_JOINTS]]
    if len(moved) > _JOINTS:
        joints.append(f"and {len(moved) - _JOINTS} more")
    tool = ""
    with suppress(IbrobotError):  # robots without a model have no tool
        tool = f"; tool from {_tool(session, begin)} to {_tool(session, end)} m"
    return AskedPath(
        seconds(points[-1].time_from_start_ns), f"{', '.join(joints) or 'ends where it begins'} [rad]{tool}"
    )


def _tool(session: RunView, joints: Mapping[str, float]) -> str:
    (placed,) = session.bus.call("/compute_fk", {"joints": joints}).poses
    at = placed.pose.position
    return f"({at.x:.2f}, {at.y:.2f}, {at.z:.2f})"
