"""The tools of agents: the run's services, as they are declared, and a few that show the robot."""

from __future__ import annotations

import base64
import enum
import json
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, get_args

import attrs
import mcp_types as types
from ibrobot_provenance.option_schemas import OptionSchemas
from ibrobot_ros2.run_cameras import cameras
from ibrobot_ros2.services import plain
from ibrobot_terminal.authority import Agent, authority_of

from ibrobot_core.api import IbrobotError, documented, option, seconds
from ibrobot_core.app import RequestError, RunView, Service, fields
from ibrobot_mcp.pictures import Sight, look

NAMES: Mapping[str, str] = {
    "/planning/go_to": "go_to",
    "/planning/plan": "plan_to",
    "/plan_kinematic_path": "plan_goals",
    "/planning/cancel": "cancel_motion",
    "/get_planning_scene": "world",
    "/estop": "stop",
    "/task/run": "run_task",
    "/task/check": "check_task",
    "/task/cancel": "cancel_task",
    "/set_mode": "enter_mode",
    "/record_episode/start": "record_episode",
    "/record_episode/stop": "end_episode",
    "/agent/status": "authority",
    "/agent/disarm": "give_up_authority",
}
"""Service -> the name of its tool; those of others are made of the service's."""
_LEFT_OUT = ("/estop/check",)
STEP = "/task/step"
"""A service whose request has one of several parts: each part is a tool, beside the service."""
_GLANCE_S = 0.02
_MOST_S = 10.0
"""Longest wait for a result within a call [s]; a part of what the lease of the authority is."""
_LONGEST = 60
"""Longest list in an answer; of longer ones, the ends are shown."""
_TEXT = 20_000
"""Longest answer, in characters."""


@documented
@attrs.frozen
class State:
    """Shows what the robot does."""


@documented
@attrs.frozen
class Look:
    """Takes pictures."""

    camera: str = option("", help="name of the camera; all by default")
    timeout: float = option(3.0, unit="s", gt=0, le=10, help="longest wait for a new picture")


@documented
@attrs.frozen
class Wait:
    """Waits for the result of what another tool began."""

    tool: str = option(help="the tool, e.g. go_to")
    number: int = option(ge=0, help="the number that it answered with")
    seconds: float = option(5.0, unit="s", ge=0, le=_MOST_S, help="longest wait")


type Content = list[types.ContentBlock]


class Way(enum.Enum):
    """How a call is carried out."""

    URGENT = enum.auto()
    """At once, beside all others."""
    READS = enum.auto()
    """Behind other calls of the agent that read, and where others leave the processor time."""
    ACTS = enum.auto()
    """Beside others; it may wait, and hold nobody up."""


@attrs.frozen(eq=False)
class RobotTool:
    """A tool of the agent."""

    service: Service[Any, Any]
    """What declares its arguments."""
    run: Callable[[Agent, Any], tuple[Content, Any]]
    """Agent and arguments -> what the agent is shown, and the same as plain data."""
    way: Way = Way.ACTS

    @property
    def urgent(self) -> bool:
        """Whether it must not wait behind others."""
        return self.way is Way.URGENT

    def described(self, name: str) -> types.Tool:
        """Its description for agents."""
        service, moves = self.service, not (self.service.reads or self.service.urgent)
        text = service.help + (" A person must grant it, see `authority`." if moves else "")
        hints = types.ToolAnnotations(read_only_hint=service.reads, destructive_hint=moves, open_world_hint=False)
        return types.Tool(name=name, description=text, input_schema=_schema(service.request), annotations=hints)


_SCHEMAS: dict[type[Any], dict[str, Any]] = {}


def _schema(request: type[Any]) -> dict[str, Any]:
    """The schema of a request. It is made once: agents may list all tools as often as they like."""
    if request not in _SCHEMAS:
        _SCHEMAS[request] = OptionSchemas().of_class(request)
    return _SCHEMAS[request]


class Tools:
    """The tools of a run.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._authority = authority_of(session)
        self._of: Mapping[str, Service[Any, Any]] | None = None
        """The services of the tools."""
        self._all: dict[str, RobotTool] = {}
        self._described: list[types.Tool] = []
        self._own: dict[str, RobotTool] = {
            "state": RobotTool(
                Service("state", State, dict, "Mode, joints, faults, and what to do about them.", reads=True),
                lambda agent, arguments: shown(self._state()),
            ),
            "look": RobotTool(
                Service("look", Look, dict, "Pictures of the cameras, with intrinsics and poses.", reads=True),
                lambda agent, arguments: self._look(arguments),
            ),
            "wait": RobotTool(
                Service("wait", Wait, dict, "Wait for the result of what another tool began.", reads=True),
                lambda agent, arguments: shown(self._wait(arguments)),
            ),
        }

    def all(self) -> dict[str, RobotTool]:
        """The tools in the robot's present mode, by name."""
        self._renew()
        return self._all

    def described(self) -> list[types.Tool]:
        """Their descriptions."""
        self._renew()
        return self._described

    def _renew(self) -> None:
        """Make the tools of the services that are served now, unless it is done: agents list them in floods."""
        services = self._session.bus.services()
        if services == self._of:
            return
        served = {
            tool_name(name): RobotTool(service, self._caller(service), _way(service))
            for name, service in services.items()
            if not service.persons and name not in _LEFT_OUT
        }
        self._all = {**served, **self._steps(services), **self._own}
        self._described = [tool.described(name) for name, tool in sorted(self._all.items())]
        self._of = services

    def _steps(self, services: Mapping[str, Service[Any, Any]]) -> dict[str, RobotTool]:
        """A tool for each kind of step that tasks have."""
        step = services.get(STEP)
        tools = {}
        for name, field in fields(step.request).items() if step is not None else ():
            kinds = [each for each in get_args(field.type) if isinstance(each, type) and attrs.has(each)]
            if step is not None and kinds and name not in self._own:
                text = f"{field.metadata['help'][:1].upper()}{field.metadata['help'][1:]}."
                part = Service(name, kinds[0], int, text)
                tools[name] = RobotTool(part, self._caller(step, name))
        return tools

    def _caller(self, service: Service[Any, Any], part: str = "") -> Callable[[Agent, Any], tuple[Content, Any]]:
        """What calls a service for an agent, with arguments that are its request, or a part of it."""

        def call(agent: Agent, arguments: Any) -> tuple[Content, Any]:
            if part:
                arguments = {part: arguments}
            answer = self._authority.call(agent, service.name, arguments)
            if service.result is None or not isinstance(answer, int):
                return shown({"answer": plain(answer)})
            return shown(self._result(service, answer, self._patience_s()))

        return call

    def _patience_s(self) -> float:
        """How long a call waits for a result: less than the agent may be silent."""
        grant = self._authority.status().grant
        return 0.0 if grant is None else min(_MOST_S, grant.lease / 2)

    def _wait(self, arguments: Any) -> Mapping[str, Any]:
        wanted = self._own["wait"].service.read(arguments)
        known = {tool_name(each.name): each for each in self._session.bus.services().values() if each.result}
        if (service := known.get(wanted.tool)) is None:
            raise RequestError(f"tool: {wanted.tool!r} answers with no number; these do: {', '.join(known) or 'none'}")
        return self._result(service, wanted.number, min(wanted.seconds, self._patience_s() or wanted.seconds))

    def _result(self, service: Service[Any, Any], number: int, patience_s: float) -> Mapping[str, Any]:
        """The result for a number, once it is there, or that it is under way."""
        assert service.result is not None
        until_s = time.monotonic() + patience_s
        while (result := self._session.bus.call(service.result, number)) is None and time.monotonic() < until_s:
            threading.Event().wait(_GLANCE_S)
        if result is not None:
            return {"number": number, "result": plain(result)}
        way = f"it is under way: call wait with tool {tool_name(service.name)}, number {number}"
        progress = {} if service.progress is None else {"progress": plain(self._session.bus.call(service.progress))}
        return {"number": number, "result": None, **progress, "next": way}

    def _state(self) -> Mapping[str, Any]:
        session = self._session
        state, config = session.state, session.config
        joints = {}
        if state is not None:
            for i, name in enumerate(config.robot.joint_names):
                joints[name] = {
                    "position_rad": round(float(state.position[i]), 4),
                    "velocity_rad_per_s": round(float(state.velocity[i]), 3),
                    "command_rad": round(float(state.command[i]), 4),
                    "limits_rad": [round(float(config.robot.lower[i]), 4), round(float(config.robot.upper[i]), 4)],
                }
        facts = {
            "robot": config.robot.name,
            "simulated": config.simulated,
            "mode": session.mode,
            "modes": list(config.control_modes),
            "joints": joints,
            "poses": list(config.robot.description.poses),
            "cameras": list(cameras(session)),
            "faults": list(session.faults),
            "authority": plain(self._authority.status()),
        }
        if session.faults:
            facts["next"] = "the robot is stopped: a person must look at it and reset it"
        elif session.held:
            facts["next"] = "the robot holds: a person must grant authority again, or enter the mode"
        if state is not None and state.success is not None:
            facts["scene_succeeded"] = state.success
        return facts

    def _look(self, arguments: Any) -> tuple[Content, Any]:
        wanted = self._own["look"].service.read(arguments)
        sights = look(self._session, wanted.camera, wanted.timeout)
        content: Content = []
        for sight in sights:
            content.append(types.TextContent(text=json.dumps(_described(sight))))
            content.append(types.ImageContent(data=base64.b64encode(sight.data).decode(), mime_type=sight.kind))
        return content, {"pictures": [_described(each) for each in sights]}


def _way(service: Service[Any, Any]) -> Way:
    if service.urgent:
        return Way.URGENT
    return Way.READS if service.reads else Way.ACTS


def tool_name(service: str) -> str:
    """The name of the tool that calls a service."""
    return NAMES.get(service) or service.strip("/").replace("/", "_")


def shown(facts: Any) -> tuple[Content, Any]:
    """An answer as content, and as plain data: motions in short, and without the middle of long lists."""
    brief = _brief(facts)
    text = json.dumps(brief, allow_nan=False, default=str)
    if len(text) > _TEXT:
        text, brief = text[:_TEXT] + " …", {"cut": True}
    return [types.TextContent(text=text)], brief


def _brief(value: Any) -> Any:
    if isinstance(value, Mapping):
        if isinstance(points := value.get("points"), list) and "joint_names" in value and points:
            ends = [[round(each, 4) for each in point["positions"]] for point in (points[0], points[-1])]
            short = {"joint_names": value["joint_names"], "from_rad": ends[0], "to_rad": ends[1]}
            return {**short, "duration_s": round(seconds(points[-1]["time_from_start_ns"]), 2)}
        return {key: _brief(each) for key, each in value.items()}
    if isinstance(value, list):
        if len(value) > _LONGEST:
            half = _LONGEST // 2
            value = [*value[:half], f"… {len(value) - 2 * half} more", *value[-half:]]
        return [_brief(each) for each in value]
    if isinstance(value, float):
        return round(value, 6) if abs(value) < float("inf") else None
    return value


def _described(sight: Sight) -> Mapping[str, Any]:
    return {name: value for name, value in attrs.asdict(sight).items() if name != "data" and value is not None}


def refusal(error: IbrobotError) -> Content:
    """An error, for the agent."""
    return [types.TextContent(text=str(error))]
