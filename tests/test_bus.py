"""The in-process bus: order, bounded queues, latching, types, services, and its promise about stamps."""

from __future__ import annotations

import threading
from bisect import bisect_right
from types import NoneType
from typing import Any

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.bus import Bus
from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.errors import RequestError, TransportError
from ibrobot_core.messages import Int32, String
from ibrobot_core.options import option
from ibrobot_core.services import Service


@attrs.frozen
class Number:
    to: int = option(help="what to add one to")


ADD = Service("/add", Number, int)


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock(1000)


@pytest.fixture
def bus(clock: SteppedClock) -> Bus:
    return Bus(clock)


def test_every_subscriber_gets_every_message_in_order(bus: Bus, clock: SteppedClock) -> None:
    first, second = bus.subscribe("/a"), bus.subscribe("/a")

    bus.publish("/a", Int32(1))
    clock.advance(5)
    bus.publish("/a", Int32(2))
    bus.publish("/b", Int32(3))

    for subscription in (first, second):
        items = subscription.drain()
        assert [(item.topic, item.message, item.received_ns) for item in items] == [
            ("/a", Int32(1), 1000),
            ("/a", Int32(2), 1005),
        ]
        assert subscription.drain() == []


@given(depth=st.integers(1, 8), count=st.integers(0, 30))
def test_a_full_queue_drops_the_oldest_and_counts_them(depth: int, count: int) -> None:
    bus = Bus(SteppedClock())
    subscription = bus.subscribe("/a", depth)

    for value in range(count):
        bus.publish("/a", Int32(value))

    kept = list(range(count))[-depth:]
    lost = count - len(kept)
    assert subscription.lost.total() == lost
    assert bus.dropped() == ({"/a": lost} if lost else {})
    assert [item.message for item in subscription.drain()] == [Int32(value) for value in kept]
    assert bus.topics() == ({"/a": ("std_msgs/msg/Int32", count)} if count else {})


def test_a_slow_subscriber_costs_the_others_nothing(bus: Bus) -> None:
    slow, quick = bus.subscribe("/a", 1), bus.subscribe("/a", 10)

    for value in range(5):
        bus.publish("/a", Int32(value))

    assert (slow.lost.total(), quick.lost.total()) == (4, 0)


def test_latched_messages_reach_later_subscribers(bus: Bus) -> None:
    bus.publish("/info", String("old"), latched=True)
    bus.publish("/info", String("new"), latched=True)
    bus.publish("/other", String("gone"))

    assert [item.message for item in bus.subscribe("/info").drain()] == [String("new")]
    assert [item.message for item in bus.subscribe(None).drain()] == [String("new")]
    assert bus.subscribe("/other").drain() == []


def test_a_subscription_to_everything(bus: Bus) -> None:
    everything = bus.subscribe(None, 1)

    bus.publish("/a", Int32(1))
    bus.publish("/b", Int32(2))

    assert [item.topic for item in everything.drain()] == ["/b"]
    assert bus.dropped() == {"*": 1}


def test_a_subscription_to_everything_that_is_wanted(bus: Bus) -> None:
    wanted = {"/a"}
    bus.publish("/b", Int32(1), latched=True)
    some = bus.subscribe(None, wants=lambda topic: topic in wanted)
    assert (bus.has_subscribers("/a"), bus.has_subscribers("/b")) == (True, False)

    bus.publish("/a", Int32(2))
    bus.publish("/b", Int32(3))
    wanted.add("/b")
    bus.publish("/b", Int32(4))

    assert [item.message for item in some.drain()] == [Int32(2), Int32(4)]


def test_a_closed_subscription_gets_nothing_more(bus: Bus) -> None:
    one, everything = bus.subscribe("/a"), bus.subscribe(None)
    one.close()
    everything.close()
    one.close()

    bus.publish("/a", Int32(1))

    assert one.get() is None
    assert everything.get() is None


def test_a_topic_keeps_its_type(bus: Bus) -> None:
    bus.publish("/a", Int32(1))

    with pytest.raises(TransportError, match=r"^topic /a carries std_msgs/msg/Int32, not std_msgs/msg/String$"):
        bus.publish("/a", String("x"))


def test_a_depth_below_one_is_refused(bus: Bus) -> None:
    with pytest.raises(ValueError, match="depth must be at least 1, got 0"):
        bus.subscribe("/a", 0)


def test_get_waits_for_a_message_and_gives_up_in_time(bus: Bus) -> None:
    subscription = bus.subscribe("/a")
    assert subscription.get() is None
    assert subscription.get(0.001) is None
    got: list[Any] = []
    waiting = threading.Thread(target=lambda: got.append(subscription.get(None)))
    waiting.start()

    bus.publish("/a", Int32(7))
    waiting.join(30.0)

    assert [item.message for item in got] == [Int32(7)]


def test_what_was_received_by_the_snapshot_is_in_the_queues() -> None:
    bus = Bus(RealClock())
    subscription = bus.subscribe("/a", 10_000)
    everything = bus.subscribe(None, 10_000)

    def publish() -> None:
        for value in range(2000):
            bus.publish("/a", Int32(value))

    publisher = threading.Thread(target=publish)
    publisher.start()
    snapshots: list[tuple[int, int]] = []
    while publisher.is_alive() or not snapshots:
        now_ns = bus.snapshot_ns()
        snapshots.append((now_ns, len(subscription._queue)))
    publisher.join()

    stamps = [item.received_ns for item in everything.drain()]
    assert len(stamps) == 2000
    assert stamps == sorted(stamps)
    for now_ns, queued in snapshots:
        assert bisect_right(stamps, now_ns) <= queued


def test_a_topic_has_the_stated_type_after_a_wrong_first_message(bus: Bus) -> None:
    bus.publish("/a", String("first"), latched=True)
    subscription = bus.subscribe("/a", 10, Int32)

    assert subscription.drain() == [], "what came before has another type"
    with pytest.raises(TransportError, match=r"^topic /a carries std_msgs/msg/Int32, not std_msgs/msg/String$"):
        bus.publish("/a", String("wrong"))
    bus.publish("/a", Int32(1))

    assert [item.message for item in subscription.drain()] == [Int32(1)]
    assert bus.topics() == {"/a": ("std_msgs/msg/Int32", 2)}


def test_types_that_are_stated_twice_must_agree(bus: Bus) -> None:
    bus.expect("/a", Int32.ros_type, String.ros_type)
    bus.subscribe("/a", 10, String)

    assert bus.expected("/a") == {String.ros_type}
    with pytest.raises(TransportError, match=r"^topic /a carries std_msgs/msg/String, not std_msgs/msg/Int32$"):
        bus.subscribe("/a", 10, Int32)
    assert bus.expected("/b") == frozenset()


def test_services_answer_and_their_absence_is_reported(bus: Bus) -> None:
    bus.serve(ADD, lambda request: request.to + 1)

    assert bus.call(ADD, Number(2)) == bus.call("/add", Number(2)) == bus.call("/add", {"to": 2}) == 3
    assert bus.services() == {"/add": ADD}
    with pytest.raises(TransportError, match=r"^service /add is served already$"):
        bus.serve(ADD, lambda request: 0)
    with pytest.raises(TransportError, match=r"^nobody serves /sub; served: /add$"):
        bus.call("/sub", 2)
    bus.unserve(ADD)
    assert not bus.serves(ADD)


def test_a_request_that_does_not_fit_never_reaches_the_handler(bus: Bus) -> None:
    seen: list[Number] = []

    def add(request: Any) -> int:
        seen.append(request)
        return 0

    bus.serve(ADD, add)

    with pytest.raises(RequestError, match=r"^/add: to: expected a whole number, got 'two'$"):
        bus.call("/add", {"to": "two"})
    assert seen == []


def test_a_service_may_publish(bus: Bus) -> None:
    subscription = bus.subscribe("/a")
    bus.serve(Service("/shout", Number, NoneType), lambda request: bus.publish("/a", Int32(request.to)))

    bus.call("/shout", Number(4))

    assert [item.message for item in subscription.drain()] == [Int32(4)]
