"""A fake transport within the process."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import override

import attrs

from ibrobot_core.api import Handler, Payload, Transport, TransportError
from ibrobot_core.app import HANDLER_THREADS


@attrs.frozen(eq=False)
class _Request:
    payload: bytes
    answer: queue.SimpleQueue[Payload | Exception] = attrs.field(factory=queue.SimpleQueue)


class _GoneError(TransportError):
    """The server died before it answered."""


class _Threads[T]:
    """Calls `act` with each item, in at most `count` threads; with one, in the order of arrival."""

    def __init__(self, act: Callable[[T], object], name: str, count: int = 1) -> None:
        self._act = act
        self._name = name
        self._pool = ThreadPoolExecutor(count, thread_name_prefix=name)

    def put(self, item: T) -> None:
        with suppress(RuntimeError):  # it has ended
            self._pool.submit(self._call, item)

    def end(self) -> None:
        """Stop processing."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _call(self, item: T) -> None:
        try:
            self._act(item)
        except Exception:
            logging.getLogger("ibrobot.testing").exception("%s failed", self._name)


class FakeTransport(Transport):
    """A transport within the process: each subscriber has its own thread, and each server several.

    Queues are unbounded.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: dict[str, list[_Threads[bytes]]] = {}
        self._servers: dict[str, _Threads[_Request]] = {}
        self._watchers: dict[str, list[_Threads[bool]]] = {}
        self._pending: dict[_Request, str] = {}
        """Requests without an answer yet, and the names of their servers."""
        self._closed = False

    @override
    def publish(self, topic: str, payload: Payload) -> None:
        kept = bytes(payload)
        with self._lock:
            self._check_open()
            for subscriber in self._subscribers.get(topic, ()):
                subscriber.put(kept)

    @override
    def subscribe(self, topic: str, callback: Callable[[Payload], object]) -> Callable[[], None]:
        subscriber = _Threads[bytes](callback, f"a subscriber of {topic}")
        with self._lock:
            self._check_open()
            self._subscribers.setdefault(topic, []).append(subscriber)
        return lambda: self._end(self._subscribers, topic, subscriber)

    @override
    def serve(self, name: str, handler: Handler, *, workers: int = HANDLER_THREADS) -> Callable[[], None]:
        def answer(request: _Request) -> None:
            try:
                request.answer.put(handler(request.payload, None))
            except Exception as error:  # noqa: BLE001 - the requester receives it
                request.answer.put(error)
            finally:
                self._pending.pop(request, None)

        server = _Threads(answer, f"the server of {name}", workers)
        with self._lock:
            self._check_open()
            if name in self._servers:
                raise TransportError(f"{name} is served already")
            self._servers[name] = server
            self._tell(name, True)

        def end() -> None:
            with self._lock:
                if self._servers.get(name) is server:
                    del self._servers[name]
                    self._tell(name, False)
            server.end()

        return end

    @override
    def request(self, name: str, payload: Payload, timeout_s: float) -> Payload:
        with self._lock:
            self._check_open()
            server = self._servers.get(name)
            if server is None:
                raise TransportError(f"nobody serves {name}")
            request = _Request(bytes(payload))
            self._pending[request] = name
            server.put(request)
        try:
            result = request.answer.get(timeout=timeout_s)
        except queue.Empty:
            raise TransportError(f"no answer from {name} within {timeout_s} s") from None
        if isinstance(result, _GoneError):
            raise result
        if isinstance(result, Exception):
            raise TransportError(f"{name} failed: {type(result).__name__}: {result}") from result
        return result

    @override
    def watch(self, name: str, changed: Callable[[bool], object]) -> Callable[[], None]:
        turn = threading.Lock()  # held until the present state is delivered, which must come first

        def tell(served: bool) -> None:
            with turn:
                changed(served)

        watcher = _Threads(tell, f"a watch of {name}")
        with turn:
            with self._lock:
                self._check_open()
                served = name in self._servers
                self._watchers.setdefault(name, []).append(watcher)
            changed(served)
        return lambda: self._end(self._watchers, name, watcher)

    @override
    def served(self, prefix: str) -> frozenset[str]:
        with self._lock:
            self._check_open()
            return frozenset(name for name in self._servers if name.startswith(prefix))

    def kill(self, *names: str) -> None:
        """End the servers of these names as the death of their process would: pending requests fail at once."""
        with self._lock:
            for name in names:
                self._servers.pop(name).end()
                self._tell(name, False)
            for request in [request for request, name in self._pending.items() if name in names]:
                name = self._pending.pop(request)
                request.answer.put(_GoneError(f"nobody serves {name}, or not any more"))

    @override
    def close(self) -> None:
        with self._lock:
            self._closed = True
            ended: list[_Threads[bytes] | _Threads[_Request] | _Threads[bool]] = [*self._servers.values()]
            for subscribers in self._subscribers.values():
                ended += subscribers
            for watchers in self._watchers.values():
                ended += watchers
            self._subscribers.clear()
            self._servers.clear()
            self._watchers.clear()
        for threads in ended:
            threads.end()

    def _end[T](self, of: dict[str, list[_Threads[T]]], key: str, threads: _Threads[T]) -> None:
        with self._lock:
            if threads in of.get(key, ()):
                of[key].remove(threads)
        threads.end()

    def _tell(self, name: str, served: bool) -> None:
        for watcher in self._watchers.get(name, ()):
            watcher.put(served)

    def _check_open(self) -> None:
        if self._closed:
            raise TransportError("the transport is closed")
