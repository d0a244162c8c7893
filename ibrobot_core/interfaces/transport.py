"""Transports: what carries bytes between processes and machines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

type Payload = bytes | bytearray | memoryview
"""Bytes, flat. What was received is not to be written to, and lives as long as a reference to it exists."""

type Handler = Callable[[Payload, str | None], Payload]
"""Makes the answer to a request. It is called with the request and the sender's name, as a certificate or password has
proved it to the transport; None where nothing proves it. What a request says of itself is not a proof."""

HANDLER_THREADS = 16
"""How many calls of a handler go on at the same time, where `serve` has no `workers`."""


class Transport(ABC):
    """Publish, subscribe, and request with a reply. Payloads are bytes; what they mean is the caller's.

    What is given to `publish` and `request` may be written to again when the call has returned.
    """

    @abstractmethod
    def publish(self, topic: str, payload: Payload) -> None:
        """Send to all subscribers of `topic`. Never blocks on a slow one.

        Raises:
            TransportError: when closed.
        """

    @abstractmethod
    def subscribe(self, topic: str, callback: Callable[[Payload], object]) -> Callable[[], None]:
        """Call `callback` with every payload on `topic`, in the order sent; returns a function that ends it.

        An exception of `callback` is logged, and reaches neither the sender nor other subscribers.
        """

    @abstractmethod
    def serve(self, name: str, handler: Handler, *, workers: int = HANDLER_THREADS) -> Callable[[], None]:
        """Answer requests for `name`; returns a function that ends it. An exception of `handler` reaches the requester.

        Args:
            name: what requests ask for.
            handler: makes the answer to a request. It is called from several threads at the same time, so that a slow
                answer does not delay the next.
            workers: how many calls go on at the same time; further requests wait.

        Raises:
            TransportError: if this transport serves the name already.
        """

    @abstractmethod
    def request(self, name: str, payload: Payload, timeout_s: float) -> Payload:
        """Ask the server of `name` and wait up to `timeout_s` [s].

        A late answer is dropped, never given to a later request.

        Raises:
            TransportError: when nobody serves it (at once), the server failed, or no answer came in time.
        """

    @abstractmethod
    def watch(self, name: str, changed: Callable[[bool], object]) -> Callable[[], None]:
        """Tell whether anybody serves `name`; returns a function that ends it.

        `changed` is called with the present state before this returns, then at each change, one call at a time, in
        another thread. A server that dies is a change as well. An exception of a later call is logged.

        Raises:
            TransportError: when closed.
        """

    def close(self) -> None:
        """End all subscriptions, services and watches; every later call is a TransportError. Safe to call twice."""
