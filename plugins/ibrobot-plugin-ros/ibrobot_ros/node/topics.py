"""Topics: serialised messages, which the node passes on as they are."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ibrobot_core.app import Channel, ChannelMessage
from ibrobot_ros.node.types import find_message

BACKLOG = 16 << 20
"""Bytes that the run may leave unread before messages for it are dropped."""
_DEPTH = 1000
"""Messages that a reader which falls behind still gets: some seconds of joint states."""
_WATCH_S = 1.0
_END_S = 0.5


def profile(name: str) -> QoSProfile:
    """The QoS profile of a name: as ROS's own tables, `default`, `sensor_data` or `latched`."""
    reliable, volatile = ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE
    if name == "latched":
        return QoSProfile(depth=1, reliability=reliable, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    if name == "sensor_data":
        return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, durability=volatile)
    return QoSProfile(depth=_DEPTH, reliability=reliable, durability=volatile)


class _Input:
    """A subscribed topic, of which at most `rate_hz` messages per second are passed on."""

    def __init__(self, topic: str, type_name: str, rate_hz: float) -> None:
        self.topic = topic
        self.type_name = type_name
        self.dropped = 0
        self._rate_hz = rate_hz
        self._burst = max(10.0, rate_hz / 10)
        self._left = self._burst
        self._last_s = time.monotonic()

    def passes(self) -> bool:
        """Whether the next message is within the rate; short bursts are."""
        now_s = time.monotonic()
        self._left = min(self._left + (now_s - self._last_s) * self._rate_hz, self._burst)
        self._last_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Topics:
    """Publishes messages of the run in ROS, and passes those of ROS to the run."""

    def __init__(self, node: Any, channel: Channel) -> None:
        self._node = node
        self._channel = channel
        self._publishers: dict[str, Any] = {}
        self._subscribers: dict[str, int] = {}
        """Topic -> the number of subscribers that the run knows of."""
        self._inputs: list[_Input] = []
        self._watched_s = 0.0
        self._reported: set[str] = set()

    def add_publisher(self, head: ChannelMessage) -> None:
        """Declare a topic of the run."""
        topic = head["topic"]

        def matched(event: Any) -> None:
            self._tell_subscribers(topic, event.current_count)

        self._try(
            topic,
            lambda: self._publishers.setdefault(
                topic,
                self._node.create_publisher(
                    find_message(head["type"], head.get("fields", ())), topic, profile(head["qos"]),
                    event_callbacks=PublisherEventCallbacks(matched=matched),
                ),
            ),
        )  # fmt: skip

    def publish(self, head: ChannelMessage) -> None:
        """Publish a message of the run."""
        publisher = self._publishers.get(head["topic"])
        if publisher is not None:
            publisher.publish(bytes(head.payload))

    def add_subscriber(self, head: ChannelMessage) -> None:
        """Subscribe to a topic for the run."""
        subscriber = _Input(head["topic"], head["type"], head["rate_hz"])

        def take(message: bytes) -> None:
            if self._channel.backlog < BACKLOG and subscriber.passes():
                self._channel.send({"op": "message", "topic": subscriber.topic}, message)
            else:
                subscriber.dropped += 1

        def incompatible(event: Any) -> None:
            self._report(subscriber.topic, "a publisher offers another QoS than this subscriber asks for; set qos")

        def make() -> None:
            kind = find_message(subscriber.type_name, head.get("fields", ()))
            self._node.create_subscription(
                kind, subscriber.topic, take, profile(head["qos"]), raw=True,
                event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
            )  # fmt: skip
            self._inputs.append(subscriber)

        self._try(subscriber.topic, make)

    def finish(self) -> None:
        """Wait until reliable subscribers have everything, at most for a moment."""
        deadline_s = time.monotonic() + _END_S
        for publisher in self._publishers.values():
            left_s = max(0.0, deadline_s - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left_s))

    def watch(self) -> None:
        """Report, once a second, the numbers of subscribers, what was dropped, and publishers of another type."""
        now_s = time.monotonic()
        if now_s - self._watched_s < _WATCH_S:
            return
        self._watched_s = now_s
        for topic, publisher in self._publishers.items():
            # Not every match is an event: without this, pictures would wait for one that never comes.
            self._tell_subscribers(topic, publisher.get_subscription_count())
        for each in self._inputs:
            dropped, each.dropped = each.dropped, 0
            if dropped:
                self._channel.send({"op": "dropped", "topic": each.topic, "count": dropped})
            for publisher in self._node.get_publishers_info_by_topic(each.topic):
                if publisher.topic_type != each.type_name:
                    self._report(
                        each.topic, f"node {publisher.node_name} publishes {publisher.topic_type}, not {each.type_name}"
                    )

    def _tell_subscribers(self, topic: str, count: int) -> None:
        if self._subscribers.get(topic, 0) != count:
            self._subscribers[topic] = count
            self._channel.send({"op": "matched", "topic": topic, "subscribers": count})

    def _report(self, topic: str, what: str) -> None:
        if f"{topic} {what}" not in self._reported:
            self._reported.add(f"{topic} {what}")
            self._channel.send({"op": "trouble", "topic": topic, "what": what})

    def _try(self, topic: str, make: Callable[[], Any]) -> None:
        try:
            make()
        except (LookupError, InvalidTopicNameException) as error:
            self._channel.send({"op": "trouble", "topic": topic, "what": f"not in ROS: {error}"})
