"""The `local` transport: within one process."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from ibrobot_core.errors import TransportError
from ibrobot_core.interfaces.transport import Transport


class LocalTransport(Transport):
    """Delivers in the sender's thread, in order. A request runs in a thread of its own so that a timeout can end it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._subscribers: dict[str, list[Callable[[bytes], None]]] = {}
        self._servers: dict[str, Callable[[bytes], bytes]] = {}
        self._closed = False

    def publish(self, topic: str, payload: bytes) -> None:
        with self._lock:
            self._check_open()
            for callback in tuple(self._subscribers.get(topic, ())):
                callback(payload)

    def subscribe(self, topic: str, callback: Callable[[bytes], None]) -> Callable[[], None]:
        with self._lock:
            self._check_open()
            self._subscribers.setdefault(topic, []).append(callback)

        def end() -> None:
            with self._lock:
                if callback in self._subscribers.get(topic, []):
                    self._subscribers[topic].remove(callback)

        return end

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

    def close(self) -> None:
        with self._lock:
            self._closed = True
            self._subscribers.clear()
            self._servers.clear()

    def _check_open(self) -> None:
        if self._closed:
            raise TransportError("the transport is closed")
