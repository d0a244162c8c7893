"""Action servers. The run decides about goals; the node reports for it."""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from ibrobot_core.app import Channel, ChannelMessage
from ibrobot_ros.node.types import fill, find_type, plain

_PATIENCE_S = 10.0
"""Longest wait for the run's decision about a goal [s]."""
_GLANCE_S = 0.001


class _Goal:
    """A goal under way, or about to be decided about."""

    def __init__(self, number: int, kind: Any, address: dict[str, Any]) -> None:
        self.number = number
        self.type = kind
        self.address = address
        """Executor or service of the run that performs it."""
        self.handle: Any = None
        self.decided: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.ended: dict[str, Any] | None = None
        self.end = threading.Event()

    def result(self) -> Any:
        """The result, after its end."""
        assert self.ended is not None
        try:
            return fill(self.type.Result(), self.ended["values"])
        except LookupError as error:  # this ROS has another definition
            return fill(self.type.Result(), {"success": False, "message": str(error)})


class Actions:
    """The action servers of a run's executors and services."""

    def __init__(self, node: Any, channel: Channel) -> None:
        self._node = node
        self._channel = channel
        self._lock = threading.Lock()
        self._count = 0
        self._goals: dict[int, _Goal] = {}

    def add(self, head: ChannelMessage) -> None:
        """Offer an action."""
        try:
            kind = find_type(head["type"])
        except LookupError as error:
            self._channel.send({"op": "trouble", "topic": head["name"], "what": f"not in ROS: {error}"})
            return
        address: dict[str, Any] = {key: head[key] for key in ("executor", "service") if key in head}
        asked: list[_Goal] = []

        def ask(request: Any) -> Any:
            goal = self._ask(kind, address, request)
            asked[:] = [goal] if goal is not None else []
            return GoalResponse.REJECT if goal is None else GoalResponse.ACCEPT

        def accept(handle: Any) -> None:
            # rclpy calls this right after `ask`, and no other callback of this server in between.
            (goal,) = asked
            goal.handle = handle
            handle.execute(lambda handle: self._execute(goal))

        ActionServer(
            self._node, kind, head["name"], execute_callback=lambda handle: None, goal_callback=ask,
            handle_accepted_callback=accept, cancel_callback=self._cancel,
            callback_group=MutuallyExclusiveCallbackGroup(),
        )  # fmt: skip

    def decide(self, head: ChannelMessage) -> None:
        """Take the run's decision about a goal, or about a cancel."""
        goal = self._goals.get(head["goal"])
        if goal is not None:
            goal.decided.put(head)

    def give_feedback(self, head: ChannelMessage) -> None:
        """Publish how a goal goes on."""
        goal = self._goals.get(head["goal"])
        if goal is not None and goal.handle is not None and not goal.end.is_set():
            goal.handle.publish_feedback(fill(goal.type.Feedback(), head["values"]))

    def end(self, head: ChannelMessage) -> None:
        """Take the end of a goal."""
        goal = self._goals.get(head["goal"])
        if goal is not None:
            goal.ended = head
            goal.end.set()

    def _ask(self, kind: Any, address: dict[str, Any], request: Any) -> _Goal | None:
        """Ask the run about a goal; None if it rejects it."""
        with self._lock:
            self._count += 1
            goal = self._goals[self._count] = _Goal(self._count, kind, address)
        self._channel.send({"op": "goal", "goal": goal.number, **address, "fields": plain(request)})
        if self._decision(goal):
            return goal
        self._channel.send({"op": "cancel", "goal": goal.number, **address})  # should the run accept it too late
        del self._goals[goal.number]
        return None

    def _decision(self, goal: _Goal) -> bool:
        try:
            return bool(goal.decided.get(timeout=_PATIENCE_S)["accepted"])
        except queue.Empty:
            return False

    def _cancel(self, handle: Any) -> Any:
        goal = next((each for each in list(self._goals.values()) if each.handle is handle), None)
        if goal is None or goal.end.is_set():
            return CancelResponse.REJECT
        self._channel.send({"op": "cancel", "goal": goal.number, **goal.address})
        return CancelResponse.ACCEPT if self._decision(goal) else CancelResponse.REJECT

    def _execute(self, goal: _Goal) -> Any:
        """Wait for the end of a goal, in a thread of the executor's pool."""
        goal.end.wait()
        assert goal.ended is not None
        state = goal.ended["state"]
        if state == "canceled":
            # rclpy notes an accepted cancel only after the callback that accepts it.
            while not goal.handle.is_cancel_requested:
                time.sleep(_GLANCE_S)
            goal.handle.canceled()
        elif state == "succeeded":
            goal.handle.succeed()
        else:
            goal.handle.abort()
        del self._goals[goal.number]
        return goal.result()
