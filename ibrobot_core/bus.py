"""The in-process bus: topics with bounded queues per subscriber, latched topics, counted drops, and the services."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable

import attrs

from ibrobot_core.clock import Clock
from ibrobot_core.errors import TransportError
from ibrobot_core.messages import Message
from ibrobot_core.services import ServiceTable

type Wants = Callable[[str], bool]
"""Whether a subscription to every topic gets the messages of one; by default it gets all."""


@attrs.frozen
class Received:
    """A message with its time of receipt by the bus [ns]."""

    topic: str
    message: Message
    received_ns: int


class Subscription:
    """A subscriber's queue with `depth` messages; when it is full, the oldest is dropped and counted."""

    def __init__(self, bus: Bus, topic: str, depth: int, wants: Wants) -> None:
        self.topic = topic
        self.depth = depth
        self.wants = wants
        self.lost = Counter[str]()
        """Topic -> number of dropped messages."""
        self._bus = bus
        self._queue: deque[Received] = deque()
        self._arrived = threading.Condition(bus._lock)

    def _put(self, item: Received) -> None:
        """Called with the bus lock held."""
        if len(self._queue) >= self.depth:
            oldest = self._queue.popleft()
            self.lost[oldest.topic] += 1
        self._queue.append(item)
        self._arrived.notify_all()

    def get(self, timeout_s: float | None = 0.0) -> Received | None:
        """The oldest queued message, or None if none arrives within `timeout_s` (None waits forever)."""
        with self._arrived:
            if not self._queue and timeout_s != 0.0:
                self._arrived.wait_for(lambda: bool(self._queue), timeout_s)
            return self._queue.popleft() if self._queue else None

    def drain(self) -> list[Received]:
        """All queued messages, oldest first."""
        with self._arrived:
            items, self._queue = list(self._queue), deque()
            return items

    def close(self) -> None:
        """End the subscription."""
        with self._arrived:
            others = [each for each in self._bus._subscriptions[self.topic] if each is not self]
            self._bus._subscriptions[self.topic] = others


class Bus(ServiceTable):
    """Publish and subscribe within a process. Publishing never blocks on a subscriber.

    Times of receipt are taken under the bus lock. So for a time from `snapshot_ns`, the queues contain every message
    received at or before it. This makes live sampling reproducible from a bag.
    """

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock
        self._subscriptions: defaultdict[str, list[Subscription]] = defaultdict(list)
        """Subscriptions by topic; the empty key has those of all topics."""
        self._types: dict[str, str] = {}
        """Type by topic: that of its first message that is not refused."""
        self._expected: dict[str, frozenset[str]] = {}
        """Types that the configuration, or what reads a topic, states."""
        self._latched: dict[str, Received] = {}
        self._counts: dict[str, int] = {}

    def expect(self, topic: str, *types: str) -> None:
        """State the types that a topic may carry, for the rest of the run; messages of other types are refused.

        Raises:
            TransportError: if others were stated before.
        """
        with self._lock:
            before = self._expected.get(topic)
            allowed = frozenset(types) & before if before is not None else frozenset(types)
            if not allowed:
                raise TransportError(f"topic {topic} carries {_any(before or types)}, not {_any(types)}")
            self._expected[topic] = allowed
            if self._types.get(topic) not in allowed:
                # Messages before were of a type that nobody had stated.
                self._types.pop(topic, None)
                self._latched.pop(topic, None)

    def expected(self, topic: str) -> frozenset[str]:
        """The types that `expect` stated for a topic; empty if nobody has."""
        with self._lock:
            return self._expected.get(topic, frozenset())

    def publish(self, topic: str, message: Message, *, latched: bool = False) -> None:
        """Deliver `message` to every subscriber of `topic`; a latched one is also delivered to later subscribers.

        Raises:
            TransportError: if the topic carries another message type.
        """
        with self._lock:
            expected = self._expected.get(topic)
            if expected is not None and message.ros_type not in expected:
                raise TransportError(f"topic {topic} carries {_any(expected)}, not {message.ros_type}")
            known = self._types.setdefault(topic, message.ros_type)
            if known != message.ros_type:
                raise TransportError(f"topic {topic} carries {known}, not {message.ros_type}")
            item = Received(topic, message, self.clock.now_ns())
            self._counts[topic] = self._counts.get(topic, 0) + 1
            if latched:
                self._latched[topic] = item
            for subscription in self._receivers(topic):
                subscription._put(item)

    def _receivers(self, topic: str) -> list[Subscription]:
        return [each for key in (topic, "") for each in self._subscriptions.get(key, ()) if each.wants(topic)]

    def subscribe(self, topic: str | None, depth: int = 10, *types: type[Message], wants: Wants = bool) -> Subscription:
        """A new queue on `topic` (None: every topic), holding the newest `depth` messages.

        Args:
            topic: the topic.
            depth: size of the queue.
            types: the types that the topic carries from now on, as `expect`; any if there are none.
            wants: of every topic, those to receive; by default all. It is asked at each message, so that it may change.

        Raises:
            ValueError: if `depth` is below one.
            TransportError: if other types were stated before.
        """
        if depth < 1:
            raise ValueError(f"depth must be at least 1, got {depth}")
        if topic is not None and types:
            self.expect(topic, *(each.ros_type for each in types))
        with self._lock:
            subscription = Subscription(self, topic or "", depth, wants)
            self._subscriptions[subscription.topic].append(subscription)
            for item in self._latched.values():
                if topic in (None, item.topic) and wants(item.topic):
                    subscription._put(item)
            return subscription

    def has_subscribers(self, topic: str) -> bool:
        """Whether anybody receives the messages of a topic; if not, there is no need to compute them."""
        with self._lock:
            return bool(self._receivers(topic))

    def snapshot_ns(self) -> int:
        """The present time [ns], such that every message received until then is in its subscribers' queues."""
        with self._lock:
            return self.clock.now_ns()

    def topics(self) -> dict[str, tuple[str, int]]:
        """Every published topic -> message type and number of messages."""
        with self._lock:
            return {topic: (self._types[topic], self._counts[topic]) for topic in sorted(self._types)}

    def latched(self) -> dict[str, Received]:
        """Latched topic -> its newest message."""
        with self._lock:
            return dict(self._latched)

    def dropped(self) -> dict[str, int]:
        """Topic -> number of messages dropped from full queues of present subscribers; only topics with losses."""
        with self._lock:
            lost = {topic: sum(each.lost.total() for each in every) for topic, every in self._subscriptions.items()}
            return {topic or "*": number for topic, number in lost.items() if number}


def _any(types: Iterable[str]) -> str:
    return " or ".join(sorted(types))
