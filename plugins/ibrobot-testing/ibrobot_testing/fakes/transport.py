"""A fake transport within the process."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from itertools import chain
from typing import Any, override

import attrs

from ibrobot_core.api import Handler, Payload, Transport, TransportError


@attrs.frozen(eq=False)
class _Server:
    handler: Handler
    threads: ThreadPoolExecutor
    died: Future[Any] = attrs.field(factory=Future)

    def end(self) -> None:
        """Begin no further request."""
        self.threads.shutdown(wait=False, cancel_futures=True)


class _Listener[T]:
    """Calls `act` with each item in a thread, in the order of arrival."""

    def __init__(self, act: Callable[[T], object], name: str) -> None:
        self._act = act
        self._name = name
        self._pool = ThreadPoolExecutor(1, thread_name_prefix=name)

    def put(self, item: T) -> None:
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
        self._subscribers: dict[str, list[_Listener[Any]]] = {}
        self._servers: dict[str, _Server] = {}
        self._watchers: dict[str, list[_Listener[Any]]] = {}
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
        subscriber = _Listener[bytes](callback, f"a subscriber of {topic}")
        with self._lock:
            self._check_open()
            self._subscribers.setdefault(topic, []).append(subscriber)
        return lambda: self._leave(self._subscribers, topic, subscriber)

    @override
    def serve(self, name: str, handler: Handler, *, workers: int = Transport.handler_threads) -> Callable[[], None]:
        server = _Server(handler, ThreadPoolExecutor(workers, f"the server of {name}"))
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
            answer = server.threads.submit(server.handler, bytes(payload), None)
        # `wait` does not notice by itself that a request was cancelled.
        answer.add_done_callback(lambda done: done.cancelled() and done.set_running_or_notify_cancel())
        wait((answer, server.died), timeout_s, FIRST_COMPLETED)
        if not answer.done():
            raise TransportError(f"no answer from {name} within {timeout_s} s, or its server has ended")
        try:
            return answer.result()
        except Exception as error:
            raise TransportError(f"{name} failed: {type(error).__name__}: {error}") from error

    @override
    def watch(self, name: str, changed: Callable[[bool], object]) -> Callable[[], None]:
        turn = threading.Lock()  # held until the present state is delivered, which must come first

        def tell(served: bool) -> None:
            with turn:
                changed(served)

        watcher = _Listener(tell, f"a watch of {name}")
        with turn:
            with self._lock:
                self._check_open()
                served = name in self._servers
                self._watchers.setdefault(name, []).append(watcher)
            changed(served)
        return lambda: self._leave(self._watchers, name, watcher)

    @override
    def served(self, prefix: str) -> frozenset[str]:
        with self._lock:
            self._check_open()
            return frozenset(name for name in self._servers if name.startswith(prefix))

    def kill(self, *names: str) -> None:
        """End the servers of these names as the death of their process would: pending requests fail at once."""
        with self._lock:
            for name in names:
                server = self._servers.pop(name)
                server.end()
                server.died.set_result(None)
                self._tell(name, False)

    @override
    def close(self) -> None:
        with self._lock:
            self._closed = True
            for server in self._servers.values():
                server.end()
            for listener in chain(*self._subscribers.values(), *self._watchers.values()):
                listener.end()
            self._subscribers.clear()
            self._servers.clear()
            self._watchers.clear()

    def _leave(self, of: dict[str, list[_Listener[Any]]], key: str, listener: _Listener[Any]) -> None:
        with self._lock, suppress(KeyError, ValueError):  # it has ended
            of[key].remove(listener)
        listener.end()

    def _tell(self, name: str, served: bool) -> None:
        for watcher in self._watchers.get(name, ()):
            watcher.put(served)

    def _check_open(self) -> None:
        if self._closed:
            raise TransportError("the transport is closed")
