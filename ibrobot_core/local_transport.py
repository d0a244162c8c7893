"""The `local` transport: within one process."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from typing import override

from ibrobot_core.errors import TransportError
from ibrobot_core.interfaces.transport import Transport

_log = logging.getLogger("ibrobot.transport.local")

_END_S = 1.0


class _Subscriber:
    """A callback with a queue and a thread of its own, so that a slow one delays nobody else."""

    def __init__(self, topic: str, callback: Callable[[bytes], None]) -> None:
        self._topic = topic
        self._callback = callback
        self._waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._ended = False
        self._thread = threading.Thread(target=self._deliver, name=f"subscriber of {topic}", daemon=True)
        self._thread.start()

    def put(self, payload: bytes) -> None:
        self._waiting.put(payload)

    def end(self) -> None:
        """Deliver nothing more. Waits a little for a callback that is running, unless it is the one that calls this."""
        self._ended = True
        self._waiting.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(_END_S)

    def _deliver(self) -> None:
        while (payload := self._waiting.get()) is not None and not self._ended:
            try:
                self._callback(payload)
            except Exception:  # noqa: BLE001 - contained: a subscriber's fault must not reach the others
                _log.exception("a subscriber of %s failed", self._topic)


class LocalTransport(Transport):
    """Delivers to each subscriber in its own thread, and answers each request in one, so that a timeout can end it.

    What a slow subscriber has not taken yet waits for it in memory.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: dict[str, list[_Subscriber]] = {}
        self._servers: dict[str, Callable[[bytes], bytes]] = {}
        self._closed = False

    @override
    def publish(self, topic: str, payload: bytes) -> None:
        with self._lock:
            self._check_open()
            for subscriber in self._subscribers.get(topic, ()):
                subscriber.put(payload)

    @override
    def subscribe(self, topic: str, callback: Callable[[bytes], None]) -> Callable[[], None]:
        with self._lock:
            self._check_open()
            subscriber = _Subscriber(topic, callback)
            self._subscribers.setdefault(topic, []).append(subscriber)

        def end() -> None:
            with self._lock:
                if subscriber in self._subscribers.get(topic, ()):
                    self._subscribers[topic].remove(subscriber)
            subscriber.end()

        return end

    @override
    def serve(self, name: str, handler: Callable[[bytes], bytes]) -> Callable[[], None]:
        with self._lock:
            self._check_open()
            if name in self._servers:
                raise TransportError(f"{name} is served already")
            self._servers[name] = handler

        def end() -> None:
            with self._lock:
                if self._servers.get(name) is handler:
                    del self._servers[name]

        return end

    @override
    def request(self, name: str, payload: bytes, timeout_s: float) -> bytes:
        with self._lock:
            self._check_open()
            handler = self._servers.get(name)
        if handler is None:
            raise TransportError(f"nobody serves {name}")
        answer: queue.SimpleQueue[bytes | Exception] = queue.SimpleQueue()

        def serve() -> None:
            try:
                answer.put(handler(payload))
            except Exception as error:  # noqa: BLE001 - it is the requester's to see
                answer.put(error)

        threading.Thread(target=serve, name=f"serve {name}", daemon=True).start()
        try:
            result = answer.get(timeout=timeout_s)
        except queue.Empty:
            raise TransportError(f"no answer from {name} within {timeout_s} s") from None
        if isinstance(result, Exception):
            raise TransportError(f"{name} failed: {type(result).__name__}: {result}") from result
        return result

    @override
    def close(self) -> None:
        with self._lock:
            self._closed = True
            ended = [subscriber for subscribers in self._subscribers.values() for subscriber in subscribers]
            self._subscribers.clear()
            self._servers.clear()
        for subscriber in ended:
            subscriber.end()

    def _check_open(self) -> None:
        if self._closed:
            raise TransportError("the transport is closed")
