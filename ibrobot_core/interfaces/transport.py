"""Transports, which carry bytes between processes and machines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

type Payload = bytes | bytearray | memoryview
"""Flat bytes. Received payloads are read-only and live as long as they are referenced."""

type Handler = Callable[[Payload, str | None], Payload]
"""Computes the answer to a request. It receives the request and the sender's name, which the transport has verified by
a certificate or password, or None if it is not verified."""


class Transport(ABC):
    """Publish, subscribe, and request with a reply. Payloads are bytes, whose meaning is up to the caller.

    The caller may modify payloads of `publish` and `request` after the call has returned.
    """

    handler_threads: ClassVar[int] = 16
    """Default of `workers` in `serve`: maximum number of concurrent calls of a handler."""

    @abstractmethod
    def publish(self, topic: str, payload: Payload) -> None:
        """Send to all subscribers of `topic`. Never blocks on a slow one.

        Raises:
            TransportError: if closed.
        """

    @abstractmethod
    def subscribe(self, topic: str, callback: Callable[[Payload], object]) -> Callable[[], None]:
        """Call `callback` with every payload on `topic`, in the order sent; returns a function that unsubscribes.

        An exception in `callback` is logged and does not affect the sender or other subscribers.
        """

    @abstractmethod
    def serve(self, name: str, handler: Handler, *, workers: int = handler_threads) -> Callable[[], None]:
        """Answer requests for `name`; returns a function that ends the service.

        Args:
            name: name of the service.
            handler: computes the answer to a request. It is called concurrently from several threads, so that a slow
                answer does not delay others. The requester receives its exceptions.
            workers: maximum number of concurrent calls; further requests wait.

        Raises:
            TransportError: if this transport serves the name already.
        """

    @abstractmethod
    def request(self, name: str, payload: Payload, timeout_s: float) -> Payload:
        """Send a request to the server of `name` and wait up to `timeout_s` [s] for the answer.

        A late answer is dropped, and never assigned to a later request.

        Raises:
            TransportError: if there is no server (at once), the server failed, or no answer arrived in time.
        """

    @abstractmethod
    def watch(self, name: str, changed: Callable[[bool], object]) -> Callable[[], None]:
        """Watch whether `name` has a server; returns a function that ends the watch.

        `changed` is called with the present state before this returns, then after each change, including the death of a
        server, one call at a time, in another thread. Exceptions in later calls are logged.

        Raises:
            TransportError: if closed.
        """

    @abstractmethod
    def served(self, prefix: str) -> frozenset[str]:
        """The names that begin with `prefix` and have a server now, e.g. all servers of one model. Does not block.

        Raises:
            TransportError: if closed.
        """

    def close(self) -> None:
        """End all subscriptions, services and watches; every later call is a TransportError. Safe to call twice."""
