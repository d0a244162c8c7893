"""Motions of a robot that a script has asked for: their state, their end, and why they failed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from enum import Enum
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import Header, JointState, PlanningError, Pose, PoseStamped, Quaternion, Vector3
from ibrobot_core.app import PlanCode
from ibrobot_planning.client.node import BaseNode

_POLL_S = 0.02
_STATE_S = 0.02
"""Age up to which a joint state is reused [s]."""


class MoveIt2State(Enum):
    """State of a motion."""

    IDLE = 0
    """Nothing is executed."""
    REQUESTING = 1
    """Never the state: requests are accepted or refused at once. For scripts that compare with it."""
    EXECUTING = 2
    """The robot plans or moves."""


@attrs.frozen
class MoveItErrorCodes:
    """moveit_msgs/msg/MoveItErrorCodes."""

    val: PlanCode
    message: str = ""
    """The robot's reason; empty after a success."""


class ExecutionFuture:
    """The end of a motion."""

    def __init__(self, motions: Motions, number: int) -> None:
        self._motions = motions
        self._number = number

    def done(self) -> bool:
        """Whether the motion has ended."""
        return self._motions.result(self._number) is not None

    def result(self) -> Mapping[str, Any]:
        """The robot's `MoveResult` as a mapping: `success`, `code`, `message` and more; waits for it."""
        return self._motions.await_result(self._number)


class Motions:
    """The motions that one client asks for."""

    def __init__(self, node: BaseNode, *, ignore_new_calls_while_executing: bool) -> None:
        self.node = node
        self._ignores = ignore_new_calls_while_executing
        self._number: int | None = None
        self._error: MoveItErrorCodes | None = None
        self._results: dict[int, Mapping[str, Any]] = {}

    def ask(self, service: str, request: Any) -> None:
        """Ask for a motion, unless one is executed and calls are ignored meanwhile."""
        if self._ignores and self.state is MoveIt2State.EXECUTING:
            self.node.get_logger().warning("the robot executes a motion; this call is ignored")
            return
        self._number, self._error = None, None
        try:
            self._number = int(self.node.call(service, request))
        except PlanningError as error:
            self.refuse(PlanCode.INVALID_GOAL_CONSTRAINTS, str(error))
            raise

    def refuse(self, code: PlanCode, message: str) -> None:
        """Remember and log why a motion does not begin."""
        self._number, self._error = None, MoveItErrorCodes(code, message)
        self.node.get_logger().warning("%s: %s", code.name, message)

    @property
    def state(self) -> MoveIt2State:
        """Whether the newest motion is under way."""
        busy = self._number is not None and self.result(self._number) is None
        return MoveIt2State.EXECUTING if busy else MoveIt2State.IDLE

    @property
    def error(self) -> MoveItErrorCodes | None:
        """How the newest motion ended; None while it is under way, and before the first."""
        if self._number is not None and (result := self.result(self._number)) is not None:
            return MoveItErrorCodes(PlanCode[result["code"]], result["message"])
        return self._error

    @property
    def future(self) -> ExecutionFuture | None:
        """The end of the newest motion; None if it did not begin."""
        return None if self._number is None else ExecutionFuture(self, self._number)

    def result(self, number: int) -> Mapping[str, Any] | None:
        """The result of a motion; None while it is under way."""
        if number not in self._results:
            result = self.node.call("/planning/result", number)
            if result is None:
                return None
            self._results[number] = result
        return self._results[number]

    def await_result(self, number: int) -> Mapping[str, Any]:
        """The result of a motion, once it has ended."""
        while (result := self.result(number)) is None:
            self.node.wait(_POLL_S)
        return result

    def wait(self) -> bool:
        """Wait for the end of the newest motion; returns whether it succeeded."""
        if self._number is None:
            if self._error is None:
                self.node.get_logger().warning("no motion was asked for, nothing to wait for")
            return False
        result = self.await_result(self._number)
        if not result["success"]:
            self.node.get_logger().warning("%s: %s", result["code"], result["message"])
        return bool(result["success"])

    def cancel(self) -> None:
        """Slow down and hold."""
        self.node.call("/planning/cancel")


class JointStates:
    """The robot's joint states, requested when they are read."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._newest: JointState | None = None
        self._asked_s = -_STATE_S

    def read(self, *, again: bool = False) -> JointState:
        """The present joint state; `again` asks the robot even if it has just answered."""
        now = time.monotonic()
        if self._newest is None or again or now - self._asked_s >= _STATE_S:
            self._newest = joint_state_from(self._node.call("/get_planning_scene")["joint_state"])
            self._asked_s = now
        return self._newest


def background[**P, T](call: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> Future[T]:
    """Call a function in another thread."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(call(*arguments, **options))
        except Exception as error:  # noqa: BLE001 - `future.result` raises it
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


def joint_state_from(value: Mapping[str, Any]) -> JointState:
    """A joint state from plain data."""
    arrays = (np.array(value[key], dtype=float) for key in ("position", "velocity", "effort"))
    return JointState(Header(**value["header"]), tuple(value["name"]), *arrays)


def pose_stamped_from(value: Mapping[str, Any]) -> PoseStamped:
    """A pose from plain data."""
    pose = value["pose"]
    return PoseStamped(Header(**value["header"]), Pose(Vector3(**pose["position"]), Quaternion(**pose["orientation"])))


def positions_of(state: JointState | Sequence[float] | None, joint_names: Sequence[str]) -> dict[str, float]:
    """Joint -> position [rad], of a joint state or of positions in the order of `joint_names`; empty for None.

    Raises:
        PlanningError: for more positions than joints.
    """
    if state is None:
        return {}
    if isinstance(state, JointState):
        return dict(zip(state.name, state.position.tolist(), strict=True))
    positions = [float(each) for each in state]
    if len(positions) > len(joint_names):
        raise PlanningError(f"{len(positions)} positions for {len(joint_names)} joints: {', '.join(joint_names)}")
    return dict(zip(joint_names, positions, strict=False))
