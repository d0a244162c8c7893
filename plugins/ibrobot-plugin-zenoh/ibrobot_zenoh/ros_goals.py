"""Goals, feedback and results of control_msgs's actions as plain data, and a client of actions."""

from __future__ import annotations

import uuid as uuids
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any

import attrs
import numpy as np
from ibrobot_ros2.interfaces import ActionType, from_cdr

from ibrobot_core.api import NS_PER_S, Message, TransportError
from ibrobot_zenoh.sharing import TopicTransport

_ANSWER_S = 10.0
"""Longest wait for the answer to a goal or a cancel [s]."""


class Status(IntEnum):
    """Status of a goal, as in action_msgs/msg/GoalStatus."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class Kind:
    """What differs between the actions of executors."""

    def request(self, goal: Any) -> tuple[dict[str, Any], Message | None]:
        """A goal for the run: its fields, and its trajectory."""
        raise NotImplementedError

    def feedback(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        """The feedback of a state of the joints."""
        raise NotImplementedError

    def result(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        """The result of an ended goal."""
        raise NotImplementedError


class _Trajectory(Kind):
    def request(self, goal: Any) -> tuple[dict[str, Any], Message | None]:
        def tolerances(each: Any) -> list[list[Any]]:
            return [[t.name, t.position, t.velocity, t.acceleration] for t in each]

        return {
            "path_tolerance": tolerances(goal.path_tolerance),
            "goal_tolerance": tolerances(goal.goal_tolerance),
            "goal_time_ns": goal.goal_time_tolerance_ns,
            "stamp_ns": goal.trajectory.header.stamp_ns,
            "other_joints": list(goal.multi_dof_trajectory.joint_names),
        }, goal.trajectory

    def feedback(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        desired, actual = np.array(head["desired"]), np.array(head["actual"])
        passed = _time(head["passed_ns"])
        return {
            "header": {"stamp": _time(head["stamp_ns"])},
            "joint_names": joints,
            "desired": {"positions": desired, "time_from_start": passed},
            "actual": {"positions": actual, "velocities": head["velocity"], "time_from_start": passed},
            "error": {"positions": desired - actual, "time_from_start": passed},
        }

    def result(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        return {"error_code": head["code"], "error_string": head["message"]}


class _Gripper(Kind):
    def request(self, goal: Any) -> tuple[dict[str, Any], Message | None]:
        return {"position": goal.command.position, "max_effort": goal.command.max_effort}, None

    def feedback(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        return {"position": head["actual"][0], "effort": head["effort"][0], **_ends(head)}

    def result(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        return {"position": head["position"], "effort": head["effort"], **_ends(head)}


class _ParallelGripper(Kind):
    def request(self, goal: Any) -> tuple[dict[str, Any], Message | None]:
        command = goal.command
        return {
            "names": list(command.name),
            "position": list(command.position),
            "velocity": list(command.velocity),
            "max_effort": list(command.effort),
        }, None

    def feedback(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        return {"state": {"name": joints, "position": head["actual"], "effort": head["effort"]}}

    def result(self, head: Mapping[str, Any], joints: list[str]) -> dict[str, Any]:
        state = {"name": joints, "position": [head["position"]], "effort": [head["effort"]]}
        return {"state": state, **_ends(head)}


ACTIONS: dict[str, Kind] = {
    "control_msgs/action/FollowJointTrajectory": _Trajectory(),
    "control_msgs/action/GripperCommand": _Gripper(),
    "control_msgs/action/ParallelGripperCommand": _ParallelGripper(),
}


def _ends(head: Mapping[str, Any]) -> dict[str, bool]:
    return {name: bool(head.get(name, False)) for name in ("stalled", "reached_goal")}


def _time(stamp_ns: int) -> dict[str, int]:
    return dict(zip(("sec", "nanosec"), divmod(stamp_ns, NS_PER_S), strict=True))


@attrs.frozen
class Ended:
    """How a goal ended."""

    status: Status
    result: dict[str, Any]


class SentGoal:
    """A goal sent to an action server, which has accepted it.

    Args:
        transport: the network.
        name: full name of the action.
        kind: its type.
        goal: the goal, as plain data.
        take_feedback: called in another thread with each feedback of this goal.

    Raises:
        TransportError: if nobody serves the action, or the goal is rejected.
        CodecError: if the goal does not fit the type.
    """

    def __init__(
        self, transport: TopicTransport, name: str, kind: ActionType, goal: Mapping[str, Any],
        take_feedback: Callable[[dict[str, Any]], object] | None = None,
    ) -> None:  # fmt: skip
        self._transport = transport
        self._name = f"{name}/_action"
        self._kind = kind
        self._id = {"uuid": list(uuids.uuid4().bytes)}
        self._take_feedback = take_feedback
        self._end = (
            transport.subscribe_cdr(f"{self._name}/feedback", self._feed) if take_feedback is not None else lambda: None
        )
        try:
            request = {"goal_id": self._id, "goal": goal}
            answer = transport.call_ros(f"{self._name}/send_goal", kind.send_goal, request, _ANSWER_S)
            if not answer["accepted"]:
                raise TransportError(f"{name} rejected the goal; the robot's log says why")
        except BaseException:
            self._end()
            raise

    def _feed(self, type_name: str, data: bytes) -> None:
        found = from_cdr(self._kind.feedback, data)
        if found["goal_id"] == self._id and self._take_feedback is not None:
            self._take_feedback(found["feedback"])

    def result(self, timeout_s: float) -> Ended:
        """Wait for the end of the goal.

        Raises:
            TransportError: if the server is gone, or it does not end within `timeout_s` [s].
        """
        try:
            answer = self._transport.call_ros(
                f"{self._name}/get_result", self._kind.get_result, {"goal_id": self._id}, timeout_s
            )
        finally:
            self._end()
        return Ended(Status(answer["status"]), answer["result"])

    def cancel(self) -> bool:
        """Cancel the goal; returns whether the server does.

        Raises:
            TransportError: if the server is gone.
        """
        request = {"goal_info": {"goal_id": self._id}}
        answer = self._transport.call_ros(f"{self._name}/cancel_goal", self._kind.cancel_goal, request, _ANSWER_S)
        return not answer["return_code"]
