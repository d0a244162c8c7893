"""A client for programs: moves a robot that `ibrobot launch` runs, or a run in the same process."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import attrs
from ibrobot_ros2.services import Answer, Call, decode_answer, decode_call, encode_answer, encode_call, endpoint

from ibrobot_core.api import (
    Context,
    IbrobotError,
    JointTrajectory,
    PlanCode,
    PlanningError,
    Pose,
    Quaternion,
    RealClock,
    Robot,
    Transport,
    Vector3,
)
from ibrobot_core.app import Runtime, installed_plugins, single_options
from ibrobot_planning.execution.requests import MoveResult
from ibrobot_planning.execution.source import EXECUTE

type GoalKeys = Mapping[str, Any]
"""A goal as plain data: `pose`, `joints` [rad], or `xyz` [m] with `axis`, `rpy` or `quaternion`, each also with
`path_constraints`; see `GoalOptions`."""

_DEFAULT = "connect=[tcp/127.0.0.1:7447]"
_TIMEOUT_S = 60.0
"""Longest time for an answer; plans take at most `planning_time`."""
_CONNECT_S = 5.0
_AGAIN_S = 0.1
_POLL_S = 0.02


@attrs.frozen
class Motion:
    """A motion that the robot has taken; a new one replaces it."""

    client: Client
    number: int

    def result(self) -> MoveResult | None:
        """How it ended; None while it is under way."""
        answer = self.client.call("/planning/result", self.number)
        return None if answer is None else MoveResult(**{**answer, "code": PlanCode[answer["code"]]})

    def wait(self) -> MoveResult:
        """Wait until it has ended."""
        while (result := self.result()) is None:
            self.client.wait(_POLL_S)
        return result


class Client:
    """Calls the services of a robot; a context manager. Made by `connect` or `of_run`.

    Goals are texts as for `ibrobot plan --goal`, or mappings. Every method raises PlanningError with the robot's reason
    if it refuses, and TransportError if it does not answer.

    Args:
        ask: takes an encoded call, and returns the encoded answer.
        wait: lets time pass [s].
        close: ends the connection.
    """

    def __init__(
        self, ask: Callable[[bytes], Any], wait: Callable[[float], None], close: Callable[[], None] = lambda: None
    ) -> None:
        self._ask = ask
        self.wait = wait
        self.close = close

    @classmethod
    def connect(cls, *options: str, namespace: str = "", transport: str = "") -> Self:
        """Connect to a robot over the network. Its YAML shares services: `transport.share.services`.

        Args:
            options: the transport's options, e.g. `connect=[tcp/192.168.1.5:7447]`; by default a robot on this machine.
            namespace: the robot's namespace, e.g. `arm1`.
            transport: type of the transport; by default the installed one.

        Raises:
            PluginError: if no transport is installed.
            ConfigError: for wrong options.
            TransportError: if no robot answers.
        """
        registry = installed_plugins()
        descriptor = registry.find("transport", transport or registry.default("transport"))
        parsed = single_options(descriptor.options, options or (_DEFAULT,), "transport", "options of Client.connect:")
        ctx = Context("client", RealClock(), logging.getLogger("ibrobot.client"), Robot("client", ()))
        made: Transport = registry.create("transport", descriptor.type, parsed, ctx)
        client = cls(lambda call: made.request(endpoint(namespace), call, _TIMEOUT_S), time.sleep, made.close)
        deadline = time.monotonic() + _CONNECT_S
        while True:  # connecting takes a moment
            try:
                client.call("/rosapi/services")
            except IbrobotError:
                if time.monotonic() > deadline:
                    client.close()
                    raise
                time.sleep(_AGAIN_S)
            else:
                return client

    @classmethod
    def of_run(cls, runtime: Runtime, on_step: Callable[[], None] = lambda: None) -> Self:
        """A client of a started run in this process. In lockstep, waiting steps the run, and calls `on_step`."""
        session = runtime.session

        def ask(data: bytes) -> bytes:
            call = decode_call(data)  # encoded as for a network, so that a program behaves the same
            try:
                return encode_answer(Answer(session.bus.call(call.service, call.request)))
            except IbrobotError as error:
                return encode_answer(Answer(str(error), result=False))

        def wait(duration_s: float) -> None:
            if not session.request.lockstep:
                time.sleep(duration_s)
                return
            for _ in range(max(1, round(duration_s * session.config.control.rate_hz))):
                runtime.step()
                on_step()

        return cls(ask, wait)

    def call(self, service: str, request: Any = None) -> Any:
        """Call any service that is served; request and answer are plain data: None, text, numbers, lists, mappings."""
        answer = decode_answer(self._ask(encode_call(Call(service, request))))
        if not answer.result:
            raise PlanningError(str(answer.values))
        return answer.values

    def go_to(self, *goals: str | GoalKeys, **scalings: float) -> Motion:
        """Plan and move; returns at once. With several goals, the first that can be reached counts.

        Args:
            goals: one text, or mappings.
            scalings: for mappings, `velocity_scaling` and `acceleration_scaling`: fractions of the limits.
        """
        service, request = _asked(goals, "/planning/go_to", "/move_action")
        return Motion(self, self.call(service, {**request, **scalings}))

    def plan(
        self, *goals: str | GoalKeys, start: Mapping[str, float] | None = None, **scalings: float
    ) -> JointTrajectory:
        """Plan without moving; arguments as for `go_to`, and `start` [rad] in place of the present positions."""
        service, request = _asked(goals, "/planning/plan", "/plan_kinematic_path")
        return self._planned(service, **request, start=start, **scalings)

    def plan_straight(
        self, *waypoints: GoalKeys, start: Mapping[str, float] | None = None, **more: Any
    ) -> JointTrajectory:
        """Plan straight lines through `xyz`; `least_fraction` of the way must be possible, by default all.

        `path_constraints` hold on the whole line, e.g. {"upright": 0.17}.
        """
        return self._planned("/compute_cartesian_path", waypoints=waypoints, start=start, **more)

    def follow(self, trajectory: JointTrajectory) -> Motion:
        """Follow a trajectory that begins where the robot is; returns at once."""
        return Motion(self, self.call(EXECUTE.name, trajectory))

    def cancel(self) -> None:
        """Slow down and hold."""
        self.call("/planning/cancel")

    def joints(self) -> dict[str, float]:
        """The present positions [rad]."""
        state = self.call("/get_planning_scene")["joint_state"]
        return dict(zip(state["name"], state["position"], strict=True))

    def ik(self, goal: GoalKeys, start: Mapping[str, float] | None = None) -> dict[str, float]:
        """Positions of all joints [rad], without contacts, for a position or pose of the tool."""
        state = self._succeeded("/compute_ik", goal=goal, start=start)["joint_state"]
        return dict(zip(state["name"], state["position"], strict=True))

    def fk(self, joints: Mapping[str, float] | None = None, link: str = "") -> Pose:
        """Pose of the tool or of a link in the base frame; joints that are not given are where they are."""
        pose = self._succeeded("/compute_fk", joints=joints, links=[link] if link else None)["poses"][0]["pose"]
        return Pose(Vector3(**pose["position"]), Quaternion(**pose["orientation"]))

    def _planned(self, service: str, **request: Any) -> JointTrajectory:
        return EXECUTE.read(self._succeeded(service, **request)["trajectory"]).trajectory()

    def _succeeded(self, service: str, **request: Any) -> Any:
        answer = self.call(service, {name: value for name, value in request.items() if value is not None})
        if (code := PlanCode[answer["code"]]) is not PlanCode.SUCCESS:
            raise PlanningError(answer["message"], code)
        return answer

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _asked(goals: Sequence[str | GoalKeys], by_text: str, by_keys: str) -> tuple[str, dict[str, Any]]:
    """The service that takes goals of this form, and its request."""
    if len(goals) == 1 and isinstance(goals[0], str):
        return by_text, {"goal": goals[0]}
    return by_keys, {"goals": goals}
