"""Transports: what carries bytes between processes and machines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable


class Transport(ABC):
    """Publish, subscribe, and request with a reply. Payloads are bytes; what they mean is the caller's."""

    @abstractmethod
    def publish(self, topic: str, payload: bytes) -> None:
        """Send to all subscribers of `topic`. Never blocks on a slow one.

        Raises:
            TransportError: when closed.
        """

    @abstractmethod
    def subscribe(self, topic: str, callback: Callable[[bytes], None]) -> Callable[[], None]:
        """Call `callback` with every payload on `topic`, in the order sent; returns a function that ends it.

        An exception of `callback` is logged, and reaches neither the sender nor other subscribers.
        """

    @abstractmethod
    def serve(self, name: str, handler: Callable[[bytes], bytes]) -> Callable[[], None]:
        """Answer requests for `name`; returns a function that ends it. An exception of `handler` reaches the requester.

        Raises:
            TransportError: if the name is served already.
        """

    @abstractmethod
    def request(self, name: str, payload: bytes, timeout_s: float) -> bytes:
        """Ask the server of `name` and wait up to `timeout_s` [s].

        A late answer is dropped, never given to a later request.

        Raises:
            TransportError: when nobody serves it, the server failed, or no answer came in time.
        """

    def close(self) -> None:
        """End all subscriptions and services; every later call is a TransportError. Safe to call twice."""
