"""Services of the run, as ROS services."""

from __future__ import annotations

import itertools
import queue
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from ibrobot_core.app import Channel, ChannelMessage
from ibrobot_ros.node.types import fill, find_type, plain

_PATIENCE_S = 120.0
"""Longest wait for the run's answer: some services answer when a motion has ended [s]."""


class Services:
    """Passes calls to the run, and its answers back. A service answers one call at a time."""

    def __init__(self, node: Any, urgent: Any, channel: Channel) -> None:
        self._nodes = {False: node, True: urgent}
        self._channel = channel
        self._numbers = itertools.count(1)
        self._waiting: dict[int, queue.SimpleQueue[dict[str, Any]]] = {}

    def add(self, head: ChannelMessage) -> None:
        """Offer a service."""
        name = head["name"]

        def call(request: Any, response: Any) -> Any:
            return fill(response, self._ask(name, plain(request)))

        try:
            self._nodes[head["urgent"]].create_service(
                find_type(head["type"]), name, call, callback_group=MutuallyExclusiveCallbackGroup()
            )
        except LookupError as error:
            self._channel.send({"op": "trouble", "topic": name, "what": f"not in ROS: {error}"})

    def answer(self, head: ChannelMessage) -> None:
        """Take the run's answer to a call."""
        waiting = self._waiting.get(head["call"])
        if waiting is not None:
            waiting.put(head)

    def _ask(self, name: str, request: dict[str, Any]) -> dict[str, Any]:
        number = next(self._numbers)
        waiting = self._waiting[number] = queue.SimpleQueue()
        self._channel.send({"op": "call", "service": name, "call": number, "request": request})
        try:
            return waiting.get(timeout=_PATIENCE_S)
        except queue.Empty:
            return {"success": False, "message": f"{name} did not answer within {_PATIENCE_S:g} s"}
        finally:
            del self._waiting[number]
