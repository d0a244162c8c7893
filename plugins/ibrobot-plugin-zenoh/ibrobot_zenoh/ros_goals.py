"""A client of actions, with goals, feedback and results as plain data."""

from __future__ import annotations

import uuid as uuids
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Any

import attrs
from ibrobot_ros2.interfaces import ActionType, from_cdr

from ibrobot_core.api import TransportError
from ibrobot_zenoh.transport import ZenohTransport

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
        self, transport: ZenohTransport, name: str, kind: ActionType, goal: Mapping[str, Any],
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
        feedback = from_cdr(self._kind.feedback, data)
        if feedback["goal_id"] == self._id and self._take_feedback is not None:
            self._take_feedback(feedback["feedback"])

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
