"""Calls of ROS 2 services as rmw_zenoh makes and answers them: a query with the request, a reply with the response."""

from __future__ import annotations

import itertools
import logging
import time
import uuid
from collections.abc import Mapping
from typing import Any

import zenoh
from ibrobot_ros2 import CodecError
from ibrobot_ros2.interfaces import ServiceType, from_cdr, to_cdr
from ibrobot_ros2.workers import StopWay, Workers

from ibrobot_core.api import TransportError
from ibrobot_zenoh.connection import first_line
from ibrobot_zenoh.network import Reply, RosHandler
from ibrobot_zenoh.own_query import OwnQuery, Query, attachment_of
from ibrobot_zenoh.ros2 import attachment, caller_of, sent_of

_WORKERS, _URGENT_WORKERS = 4, 2
_CHECK_S = 10.0
"""Longest wait for the answer of a server that is tried out [s]."""
_CALLER = uuid.uuid4().bytes
"""Id of this process as a client."""
_numbers = itertools.count(1)


def sent_now() -> bytes:
    """The attachment of a request that is sent now."""
    return attachment(next(_numbers), time.time_ns(), _CALLER)


class RosServer:
    """Answers the queries of a service.

    A query is kept until its response is sent: dropping it ends the wait of its client. Requests that cannot be read
    are dropped in this way, with a warning, since ROS has no word for them.
    """

    def __init__(
        self, name: str, kind: ServiceType, handler: RosHandler, log: logging.Logger, depth: int, way: StopWay | None
    ) -> None:  # fmt: skip
        self._name = name
        self._kind = kind
        self._handler = handler
        self._log = log
        self._way = way
        self._checks: dict[Query, RosHandler] = {}
        """What answers queries that only try the server out."""
        count = _WORKERS if way is None else _URGENT_WORKERS
        self.workers = Workers(self._answer, f"the server of {name}", count, depth, way)

    def take(self, query: Query) -> None:
        """Queue a query."""
        try:
            rejected = self.workers.put(query)
            if rejected is not None:
                _end(rejected)
                self._log.warning("%s is overloaded, or has no thread: a call was dropped", self._name)
        except BaseException as error:
            if self._way is not None:
                self._way.lose(error)
            raise

    def try_out(self, check: RosHandler) -> None:
        """Call `check`, by the queue and a thread of calls that come from others.

        Raises:
            TransportError: if there is no answer, or one without `success`.
        """
        query = OwnQuery(to_cdr(self._kind.request, {}), "own", sent_now())
        self._checks[query] = check
        self.take(query)
        answer = from_cdr(self._kind.response, query.answer(_CHECK_S))
        if not answer["success"]:
            raise TransportError(f"a call of {self._name} would fail: {answer['message']}")

    def _answer(self, query: Query) -> None:
        payload, attached = query.payload, attachment_of(query)
        number, caller = caller_of(attached)

        def send(response: Mapping[str, Any]) -> None:
            with query:
                sent = attachment(number, time.time_ns(), caller)
                try:
                    query.reply(query.key_expr, to_cdr(self._kind.response, response), attachment=sent, express=True)
                except zenoh.ZError as error:  # its client is gone
                    self._log.debug("%s: %s", self._name, first_line(error))

        handler = self._checks.pop(query, self._handler) if self._checks else self._handler
        reply = Reply(send, sent_of(attached))
        try:
            handler(from_cdr(self._kind.request, payload.to_bytes() if payload is not None else b""), reply)
        except CodecError as error:
            self._log.warning("a call of %s was dropped: %s", self._name, error)
            _end(query)
        except Exception:
            _end(query)
            raise


def _end(query: Query) -> None:
    """Answer nothing."""
    with query:
        pass


def call(
    session: zenoh.Session, key: str, name: str, kind: ServiceType, request: Mapping[str, Any], timeout_s: float
) -> dict[str, Any]:
    """Call a service; see `ZenohTransport.call_ros`."""
    try:
        replies = session.get(
            key,
            payload=to_cdr(kind.request, request),
            attachment=sent_now(),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
    except zenoh.ZError as error:
        raise TransportError(f"{name}: {first_line(error)}") from error
    began_s = time.monotonic()
    for reply in replies:
        if (sample := reply.ok) is not None:
            return from_cdr(kind.response, sample.payload.to_bytes())
    if time.monotonic() - began_s < timeout_s:
        raise TransportError(f"nobody serves {name} as {kind.name}, or it refused the request")
    raise TransportError(f"no answer from {name} within {timeout_s:g} s")
