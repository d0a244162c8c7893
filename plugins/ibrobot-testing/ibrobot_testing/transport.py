"""The conformance suite of transports."""

from __future__ import annotations

import gc
import logging
import queue
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import ClassVar, Self, override

import pytest

from ibrobot_core.api import Context, Payload, Transport, TransportError
from ibrobot_core.app import LogFormatter
from ibrobot_testing.suite import Suite, wait_until

_HELD_S = 120.0
"""Maximum time for which a callback is blocked [s]; longer than all waits, so that no callback continues by itself."""


class _Log(logging.Handler):
    """All log records of this process, while it is open."""

    def __init__(self) -> None:
        super().__init__()
        self._records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
        self._texts: list[str] = []

    @override
    def emit(self, record: logging.LogRecord) -> None:
        self._records.put(record)

    def text(self) -> str:
        """What was logged, with tracebacks."""
        while not self._records.empty():
            self._texts.append(LogFormatter().format(self._records.get()))
        return "\n".join(self._texts)

    def __enter__(self) -> Self:
        logging.getLogger().addHandler(self)
        return self

    def __exit__(self, *raised: object) -> None:
        logging.getLogger().removeHandler(self)


class TransportSuite(Suite[Transport]):
    """Checks of every `Transport`, between two ends."""

    wait_s: ClassVar[float] = 30.0
    """How long a check waits for expected events [s]."""
    short_s: ClassVar[float] = 0.05
    """How long a check waits for unexpected events [s]."""

    def make_pair(self, ctx: Context) -> tuple[Transport, Transport]:
        """Two connected ends; one object twice for a transport within a process."""
        transport = self.make(ctx)
        return transport, transport

    def settle(self, near: Transport, far: Transport) -> None:
        """Wait until each end knows the subscriptions and services of the other."""

    def kill(self, far: Transport, name: str) -> None:
        """End the server of `name` as the death of its process does. Override it to have this checked."""
        pytest.skip("override kill to have the death of a server checked")

    @contextmanager
    def ends(self) -> Iterator[tuple[Transport, Transport]]:
        """Two connected ends."""
        near, far = self.make_pair(self.context())
        try:
            yield near, far
        finally:
            near.close()
            far.close()

    @contextmanager
    def held(self) -> Iterator[threading.Event]:
        """An event that blocks callbacks until the end of the block."""
        go_on = threading.Event()
        try:
            yield go_on
        finally:
            go_on.set()

    def test_delivers_in_order(self) -> None:
        """Every payload, even if empty or large, arrives once, complete, and in order."""
        payloads = [b"", b"\x00\xff" * 500_000, *(str(i).encode() for i in range(200))]
        with self.ends() as (near, far):
            arrived: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            far.subscribe("topic", arrived.put)
            self.settle(near, far)
            for payload in payloads:
                near.publish("topic", payload)
            assert [arrived.get(timeout=self.wait_s) for _ in payloads] == payloads

    def test_every_subscriber_gets_its_topic_only(self) -> None:
        """Each subscriber of a topic gets every payload on it, and no others."""
        with self.ends() as (near, far):
            first: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            second: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            far.subscribe("a", first.put)
            far.subscribe("a", second.put)
            self.settle(near, far)
            near.publish("b", b"other")
            near.publish("a", b"own")
            assert first.get(timeout=self.wait_s) == second.get(timeout=self.wait_s) == b"own"

    def test_an_ended_subscription_is_silent(self) -> None:
        """After its end a subscription delivers nothing; others do."""
        with self.ends() as (near, far):
            ended: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            going: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            end = far.subscribe("topic", ended.put)
            far.subscribe("topic", going.put)
            self.settle(near, far)
            end()
            end()
            near.publish("topic", b"x")
            assert going.get(timeout=self.wait_s) == b"x"
            with pytest.raises(queue.Empty):
                ended.get(timeout=self.short_s)

    def test_an_ended_subscription_drops_what_waits(self) -> None:
        """What waited behind a callback when its subscription ended is not delivered."""
        with self.ends() as (near, far), ThreadPoolExecutor() as pool, self.held() as release:
            ended: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            going: queue.SimpleQueue[Payload] = queue.SimpleQueue()

            def slow(payload: Payload) -> None:
                ended.put(payload)
                release.wait(_HELD_S)

            end = far.subscribe("topic", slow)
            far.subscribe("topic", going.put)
            self.settle(near, far)
            pool.submit(lambda: [near.publish("topic", payload) for payload in (b"1", b"2")])
            assert [going.get(timeout=self.wait_s) for _ in range(2)] == [b"1", b"2"]
            assert ended.get(timeout=self.wait_s) == b"1"
            ending = pool.submit(end)
            wait([ending], self.short_s)
            release.set()
            ending.result(self.wait_s)
            with pytest.raises(queue.Empty):
                ended.get(timeout=self.short_s)

    def test_callbacks_may_end_themselves(self) -> None:
        """A callback may end its own subscription or watch, and a server its own service."""
        with self.ends() as (near, far):
            ends: dict[str, Callable[[], None]] = {}
            ended: queue.SimpleQueue[str] = queue.SimpleQueue()

            def end(name: str) -> None:
                ends[name]()
                ended.put(name)

            ends["subscription"] = far.subscribe("topic", lambda payload: end("subscription"))
            ends["watch"] = near.watch("echo", lambda served: end("watch") if served else None)

            def answer(payload: Payload, _: str | None) -> Payload:
                end("service")
                return payload

            ends["service"] = far.serve("echo", answer)
            self.settle(near, far)
            near.publish("topic", b"x")
            assert near.request("echo", b"x", self.wait_s) == b"x"
            assert {ended.get(timeout=self.wait_s) for _ in ends} == set(ends)

    def test_a_slow_subscriber_blocks_nobody(self) -> None:
        """`publish` returns and others are served while one callback blocks; it is not called again meanwhile."""
        with self.ends() as (near, far), ThreadPoolExecutor() as pool, self.held() as release:
            arrived: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            begun: queue.SimpleQueue[Payload] = queue.SimpleQueue()

            def slow(payload: Payload) -> None:
                begun.put(payload)
                release.wait(_HELD_S)

            far.subscribe("topic", slow)
            far.subscribe("topic", arrived.put)
            self.settle(near, far)
            publishing = pool.submit(lambda: [near.publish("topic", b"x") for _ in range(3)])
            done, _ = wait([publishing], self.wait_s / 2)
            assert done, "publish waits for a slow subscriber"
            for _ in range(3):
                assert arrived.get(timeout=self.wait_s / 2) == b"x"
            assert begun.get(timeout=self.wait_s / 2) == b"x"
            with pytest.raises(queue.Empty):
                begun.get(timeout=self.short_s)

    def test_a_failing_subscriber_harms_nobody(self) -> None:
        """An exception in a callback is logged, and affects neither publisher nor others; it is called again."""
        with self.ends() as (near, far), _Log() as log:
            calls: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            arrived: queue.SimpleQueue[Payload] = queue.SimpleQueue()

            def failing(payload: Payload) -> None:
                calls.put(payload)
                raise ValueError("the callback failed")

            far.subscribe("topic", failing)
            far.subscribe("topic", arrived.put)
            self.settle(near, far)
            for payload in (b"1", b"2"):
                near.publish("topic", payload)
                assert arrived.get(timeout=self.wait_s) == payload
                assert calls.get(timeout=self.wait_s) == payload
            wait_until(lambda: "the callback failed" in log.text(), self.wait_s)

    def test_each_request_gets_its_own_answer(self) -> None:
        """Concurrent requests each get their own answer."""
        with self.ends() as (near, far), ThreadPoolExecutor(20) as pool:
            far.serve("echo", lambda payload, _: bytes(payload) + b"!")
            self.settle(near, far)
            answers = pool.map(lambda i: near.request("echo", str(i).encode(), self.wait_s), range(20))
            assert list(answers) == [f"{i}!".encode() for i in range(20)]

    def test_sent_buffers_are_free_again(self) -> None:
        """A bytearray or a view of one can be sent, and modified after the call has returned."""
        with self.ends() as (near, far), self.held() as going_on:
            arrived: queue.SimpleQueue[Payload] = queue.SimpleQueue()
            served, sender = threading.Event(), threading.get_ident()

            def slow(payload: Payload) -> None:
                assert threading.get_ident() != sender, "publish calls the subscribers itself"
                going_on.wait(_HELD_S)
                arrived.put(bytes(payload))

            def answer(payload: Payload, _: str | None) -> Payload:
                if payload == b"late":
                    going_on.wait(_HELD_S)
                    arrived.put(bytes(payload))
                    served.set()
                return bytearray(payload)

            far.subscribe("topic", slow)
            far.serve("echo", answer)
            self.settle(near, far)
            buffer = bytearray(b"sent")
            near.publish("topic", memoryview(buffer))
            assert near.request("echo", buffer, self.wait_s) == b"sent"
            buffer[:] = b"late"
            with pytest.raises(TransportError):
                near.request("echo", memoryview(buffer), self.short_s)
            buffer[:] = b"next"
            going_on.set()
            assert served.wait(self.wait_s)
            assert {bytes(arrived.get(timeout=self.wait_s)) for _ in range(2)} == {b"sent", b"late"}

    def test_a_slow_answer_delays_no_other(self) -> None:
        """Requests are answered concurrently, with at most one per worker."""
        with self.ends() as (near, far), ThreadPoolExecutor() as pool, self.held() as release:
            begun: queue.SimpleQueue[Payload] = queue.SimpleQueue()

            def answer(payload: Payload, _: str | None) -> Payload:
                begun.put(payload)
                if payload != b"quick":
                    release.wait(_HELD_S)
                return payload

            far.serve("echo", answer, workers=2)
            self.settle(near, far)
            pool.submit(near.request, "echo", b"slow", self.wait_s)
            assert begun.get(timeout=self.wait_s) == b"slow"
            assert near.request("echo", b"quick", self.wait_s / 2) == begun.get() == b"quick"
            pool.submit(near.request, "echo", b"slower", self.wait_s)
            assert begun.get(timeout=self.wait_s) == b"slower"
            with pytest.raises(TransportError):
                near.request("echo", b"quick", self.short_s)
            assert begun.empty()

    def test_a_late_answer_is_dropped(self) -> None:
        """A request with a late answer fails, and its answer is not delivered to the next one."""
        with self.ends() as (near, far), self.held() as release:
            done = threading.Event()

            def answer(payload: Payload, _: str | None) -> Payload:
                if payload == b"slow":
                    release.wait(_HELD_S)
                    done.set()
                return payload

            far.serve("echo", answer)
            self.settle(near, far)
            with pytest.raises(TransportError):
                near.request("echo", b"slow", self.short_s)
            release.set()
            assert done.wait(self.wait_s)
            for i in range(5):
                assert near.request("echo", str(i).encode(), self.wait_s) == str(i).encode()

    def test_a_servers_error_reaches_the_requester(self) -> None:
        """An exception in the server is a TransportError with its text for the requester; the service continues."""
        with self.ends() as (near, far):

            def answer(payload: Payload, _: str | None) -> Payload:
                if payload == b"bad":
                    raise ValueError("no such thing as bad")
                return payload

            far.serve("echo", answer)
            self.settle(near, far)
            with pytest.raises(TransportError, match="no such thing as bad"):
                near.request("echo", b"bad", self.wait_s)
            assert near.request("echo", b"good", self.wait_s) == b"good"

    def test_nobody_serves(self) -> None:
        """A request for a name without a server is a TransportError, also after its server has ended."""
        with self.ends() as (near, far):
            with pytest.raises(TransportError):
                near.request("nobody", b"", self.short_s)
            end = far.serve("echo", lambda payload, _: payload)
            self.settle(near, far)
            assert near.request("echo", b"x", self.wait_s) == b"x"
            end()
            with pytest.raises(TransportError):
                near.request("echo", b"x", self.short_s)

    def test_an_ended_server_begins_no_request(self) -> None:
        """Requests that still wait for a worker when their server ends fail at once, and are not begun."""
        with self.ends() as (near, far), ThreadPoolExecutor() as pool, self.held() as release:
            begun: queue.SimpleQueue[Payload] = queue.SimpleQueue()

            def answer(payload: Payload, _: str | None) -> Payload:
                begun.put(payload)
                release.wait(_HELD_S)
                return payload

            end = far.serve("echo", answer, workers=1)
            self.settle(near, far)
            pool.submit(near.request, "echo", b"first", self.wait_s)
            assert begun.get(timeout=self.wait_s) == b"first"
            second = pool.submit(near.request, "echo", b"second", 2 * self.wait_s)
            wait([second], self.short_s)
            wait([pool.submit(end)], self.short_s)
            release.set()
            with pytest.raises(TransportError):
                second.result(self.wait_s)
            assert begun.empty()

    def test_the_death_of_a_server_ends_what_waits_for_it(self) -> None:
        """When a server dies, a pending request is a TransportError at once, and watches report it."""
        with self.ends() as (near, far), ThreadPoolExecutor() as pool, self.held() as release:
            begun = threading.Event()

            def answer(payload: Payload, _: str | None) -> Payload:
                begun.set()
                release.wait(_HELD_S)
                return payload

            far.serve("echo", answer)
            self.settle(near, far)
            told: queue.SimpleQueue[bool] = queue.SimpleQueue()
            near.watch("echo", told.put)
            assert told.get_nowait() is True
            asked = pool.submit(near.request, "echo", b"x", 2 * self.wait_s)
            assert begun.wait(self.wait_s)
            self.kill(far, "echo")
            with pytest.raises(TransportError):
                asked.result(self.wait_s)
            assert told.get(timeout=self.wait_s) is False
            with pytest.raises(TransportError):
                near.request("echo", b"x", self.short_s)

    def test_a_name_is_served_once(self) -> None:
        """A second server of a name is refused until the first has ended."""
        with self.ends() as (near, far):
            end = far.serve("echo", lambda payload, _: b"first")
            with pytest.raises(TransportError, match="echo"):
                far.serve("echo", lambda payload, _: b"second")
            self.settle(near, far)
            assert near.request("echo", b"", self.wait_s) == b"first"
            end()
            far.serve("echo", lambda payload, _: b"third")
            self.settle(near, far)
            assert near.request("echo", b"", self.wait_s) == b"third"

    def test_a_watch_tells_who_serves(self) -> None:
        """A watch reports the present state at once, then every change, until it ends."""
        with self.ends() as (near, far):
            early: queue.SimpleQueue[bool] = queue.SimpleQueue()
            late: queue.SimpleQueue[bool] = queue.SimpleQueue()
            end_early = near.watch("echo", early.put)
            assert early.get_nowait() is False
            near.watch("other", lambda served: early.put(served) if served else None)
            for _ in range(2):
                end = far.serve("echo", lambda payload, _: payload)
                assert early.get(timeout=self.wait_s) is True
                end_late = near.watch("echo", late.put)
                assert late.get_nowait() is True
                end()
                assert early.get(timeout=self.wait_s) is False
                assert late.get(timeout=self.wait_s) is False
                end_late()
            end_early()
            end_early()
            last = near.watch("echo", late.put)
            assert late.get_nowait() is False
            far.serve("echo", lambda payload, _: payload)
            assert late.get(timeout=self.wait_s) is True
            with pytest.raises(queue.Empty):
                early.get(timeout=self.short_s)
            last()

    def test_served_names_are_listed(self) -> None:
        """`served` has the names with a prefix, on both ends, for as long as they have a server."""
        with self.ends() as (near, far):
            ends = [far.serve(name, lambda payload, _: payload) for name in ("echo/1", "echo/2", "other")]
            self.settle(near, far)
            wait_until(lambda: near.served("echo/") == far.served("echo/") == {"echo/1", "echo/2"}, self.wait_s)
            assert near.served("echo/2") == {"echo/2"}
            ends[0]()
            wait_until(lambda: near.served("echo/") == far.served("echo/") == {"echo/2"}, self.wait_s)

    def test_a_server_may_use_the_transport(self) -> None:
        """Callbacks and servers may publish and send requests."""
        with self.ends() as (near, far):
            arrived: queue.SimpleQueue[Payload] = queue.SimpleQueue()

            def answer(payload: Payload, _: str | None) -> Payload:
                far.publish("asked", payload)
                return payload

            near.subscribe("asked", arrived.put)
            far.serve("echo", answer)
            self.settle(near, far)
            assert near.request("echo", b"x", self.wait_s) == b"x"
            assert arrived.get(timeout=self.wait_s) == b"x"

    def test_ended_callbacks_do_not_accumulate(self) -> None:
        """Callbacks of ended subscriptions and watches are not kept; Zenoh keeps the last one of a topic."""

        class Callback:
            def __call__(self, _: object) -> None:
                pass

        with self.ends() as (near, _):
            for begin in (near.subscribe, near.watch):
                kept: list[weakref.ref[Callback]] = []
                for _ in range(3):
                    callback = Callback()
                    kept.append(weakref.ref(callback))
                    begin("name", callback)()
                    del callback

                def kept_at_most_one(kept: list[weakref.ref[Callback]] = kept) -> bool:
                    gc.collect()
                    return sum(each() is not None for each in kept) <= 1

                wait_until(kept_at_most_one, self.wait_s)

    def test_a_closed_transport_refuses(self) -> None:
        """After `close`, which is safe twice, every call is a TransportError; what it ended can be ended again."""
        with self.ends() as (near, _):
            ends = (
                near.subscribe("topic", lambda payload: None),
                near.watch("name", lambda served: None),
                near.serve("name", lambda payload, _: payload),
            )
            near.close()
            near.close()
            for end in ends:
                end()
            calls: tuple[Callable[[], object], ...] = (
                lambda: near.publish("topic", b""),
                lambda: near.subscribe("topic", lambda payload: None),
                lambda: near.serve("name", lambda payload, _: payload),
                lambda: near.request("name", b"", self.short_s),
                lambda: near.watch("name", lambda served: None),
                lambda: near.served("name"),
            )
            for call in calls:
                with pytest.raises(TransportError):
                    call()
