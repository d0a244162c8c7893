"""A query that does not come from the network: it tries out what answers those that do."""

from __future__ import annotations

import queue
from typing import Any, Self

import zenoh

from ibrobot_core.api import TransportError


class OwnQuery:
    """Stands for a `zenoh.Query` of this process itself, as far as servers use one.

    Args:
        request: its payload.
        key: its key, with the sender.
        attached: its attachment.
    """

    def __init__(self, request: bytes, key: str, attached: bytes = b"") -> None:
        self.payload = zenoh.ZBytes(request)
        self.attachment = zenoh.ZBytes(attached)
        self.key_expr = zenoh.KeyExpr(key)
        self._answers: queue.SimpleQueue[bytes | TransportError] = queue.SimpleQueue()

    def reply(self, key: zenoh.KeyExpr, payload: Any, *, attachment: Any = None, express: bool = False) -> None:
        """Take the reply."""
        self._answers.put(bytes(payload))

    def reply_err(self, payload: str, *, encoding: zenoh.Encoding) -> None:
        """Take an error."""
        self._answers.put(TransportError(payload))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self._answers.put(TransportError("it was dropped"))

    def answer(self, timeout_s: float) -> bytes:
        """The reply; waits up to `timeout_s` [s].

        Raises:
            TransportError: if there is none, or an error.
        """
        try:
            answer = self._answers.get(timeout=timeout_s)
        except queue.Empty:
            raise TransportError(f"no answer within {timeout_s:g} s") from None
        if isinstance(answer, TransportError):
            raise answer
        return answer


type Query = zenoh.Query | OwnQuery


def attachment_of(query: Query) -> bytes:
    """The attachment of a query; empty without one."""
    return query.attachment.to_bytes() if query.attachment is not None else b""
