"""What a protocol must offer: requests, one at a time, each with its own answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

_SHOWN = 500
"""Characters of a server's error that are shown: some send a whole traceback."""


def one_line(text: str) -> str:
    """The end of a server's error, on one line."""
    return " ".join(text.split())[-_SHOWN:]


class Connection(ABC):
    """A connection to a server.

    After any error it must be closed: what arrives later could be the answer to an earlier request. Errors do not name
    the server: `ServedPolicy` adds its address.
    """

    address: str
    """Of the server."""

    @abstractmethod
    def open(self, timeout_s: float) -> Mapping[str, Any]:
        """Connect, and return what the server tells about itself; empty if it tells nothing.

        Raises:
            PolicyError: if there is no server, or it does not speak this protocol.
        """

    @abstractmethod
    def ask(self, request: Mapping[str, Any], timeout_s: float) -> Mapping[str, Any]:
        """Send a request, and return its answer.

        Raises:
            PolicyError: if there is none in time, or it is an error or damaged.
        """

    @abstractmethod
    def reset(self, timeout_s: float) -> None:
        """Begin a new episode, if the protocol has a message for it."""

    @abstractmethod
    def interrupt(self) -> None:
        """Make a request in another thread fail soon."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect. Safe to call twice."""
