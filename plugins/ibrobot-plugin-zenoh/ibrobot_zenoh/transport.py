"""The transport: publish and subscribe, requests answered by several threads, and liveliness."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, override

import zenoh
from ibrobot_ros2.interfaces import ServiceType
from ibrobot_ros2.workers import StopWay, Workers

from ibrobot_core.api import Context, Handler, Payload, TransportError
from ibrobot_zenoh.access import ANYBODY, SERVED, SERVICES, TOPICS
from ibrobot_zenoh.connection import first_line
from ibrobot_zenoh.network import RosHandler, Urgent, UrgentHandler
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.own_query import OwnQuery, Query, attachment_of
from ibrobot_zenoh.presence import Presence
from ibrobot_zenoh.ros2 import sent_of, service_key
from ibrobot_zenoh.ros_calls import RosServer, call, sent_now
from ibrobot_zenoh.topics import RosTransport

SUBSCRIBER_DEPTH = 1000
"""Queue size of a subscriber; when it is full, the oldest payload is dropped."""
REQUESTS_WAITING = 64
"""Queue size of a server; when it is full, the oldest request fails because the server is overloaded."""
URGENT_WAITING = 10_000
"""Queue size for urgent requests."""
_URGENT_WORKERS = 2
_FAILED = zenoh.Encoding.TEXT_PLAIN
"""Marks error replies of a server, as opposed to Zenoh's own for a timeout."""


@lru_cache
def _key(prefix: str, name: str) -> zenoh.KeyExpr:
    try:
        key = zenoh.KeyExpr(f"{prefix}/{name.removeprefix('/')}")
    except zenoh.ZError as error:
        raise TransportError(f"{name!r} cannot be a name here: {first_line(error)}") from error
    if "*" in name:
        raise TransportError(f"{name!r} cannot be a name here: it has a *")
    return key


def _sendable(payload: Payload) -> bytes | bytearray:
    """A payload in a type that Zenoh accepts: it takes no views."""
    if not isinstance(payload, memoryview):
        return payload
    whole = payload.obj
    if isinstance(whole, bytes | bytearray) and len(whole) == payload.nbytes and payload.c_contiguous:
        return whole
    return payload.tobytes()


def _put(workers: Workers[Query], query: Query) -> None:
    """Queue a query; one that is not taken is answered with an error at once."""
    rejected = workers.put(query)
    if rejected is not None:
        with rejected:
            rejected.reply_err("it is overloaded, has no thread for it, or is about to end", encoding=_FAILED)


class ZenohTransport(RosTransport):
    """Payloads over Zenoh, under the keys of `ibrobot_zenoh.access`; messages as ROS 2 nodes send them."""

    def __init__(self, options: ZenohOptions, ctx: Context) -> None:
        super().__init__(options, ctx)
        self._sender_name = ANYBODY if self.own is None else self.own.name
        self._presence = Presence(self.connection)
        self._served: set[str] = set()

    @override
    def publish(self, topic: str, payload: Payload) -> None:
        self._check_size(len(payload), topic)
        if self.own is not None:
            self.own.check_may_publish(topic)
        key = _key(TOPICS, topic)
        session = self.connection.open_session
        if session is not None:  # without a session there are no subscribers
            # May wait for the link, but never for a subscriber, as these have queues.
            try:
                session.put(key, _sendable(payload), congestion_control=zenoh.CongestionControl.BLOCK)
            except zenoh.ZError as error:
                raise TransportError(f"{topic}: {first_line(error)}") from error

    @override
    def subscribe(self, topic: str, callback: Callable[[Payload], object]) -> Callable[[], None]:
        name = f"a subscriber of {topic}"
        subscriber = Workers[zenoh.Sample](
            lambda sample: callback(sample.payload.to_bytes()), name, 1, SUBSCRIBER_DEPTH
        )

        def take(sample: zenoh.Sample) -> None:
            if subscriber.put(sample) is not None:
                self._log.warning("%s is too slow: a payload was dropped", name)

        key = _key(TOPICS, topic)
        return self._keep(self.connection.declare(lambda session: session.declare_subscriber(key, take)), subscriber)

    @override
    def serve(self, name: str, handler: Handler, *, workers: int = RosTransport.handler_threads) -> Callable[[], None]:
        server = self._workers_of(name, lambda request, sender, sent_ns: handler(request, sender), workers)
        limit = self.options.max_message_size

        def take(query: Query) -> None:
            size = len(query.payload) if query.payload is not None else 0
            if size > limit:
                with query:
                    query.reply_err(f"a request of {size} bytes, at most {limit} are read", encoding=_FAILED)
            else:
                _put(server, query)

        return self._serve(name, take, server)

    @override
    def serve_with_urgent(
        self, name: str, handler: UrgentHandler, is_urgent: Callable[[Payload], bool], largest: int, way: StopWay
    ) -> Urgent:
        def answer_or_raise(query: Query) -> None:
            if (error := self._answer(name, handler, query)) is not None:
                raise error

        # A long queue: urgent requests must not be dropped.
        urgent = Workers(answer_or_raise, f"the urgent requests of {name}", _URGENT_WORKERS, URGENT_WAITING, way)
        server = self._workers_of(name, handler, self.handler_threads)

        def take(query: Query) -> None:
            try:
                payload = query.payload
                size = len(payload) if payload is not None else 0
                if size > largest:
                    with query:
                        query.reply_err(f"a request of {size} bytes, at most {largest} are read", encoding=_FAILED)
                    return
                data = payload.to_bytes() if payload is not None else b""
                _put(urgent if is_urgent(data) else server, query)
            except BaseException as error:
                way.lose(error)
                raise

        def ask(request: bytes, timeout_s: float) -> bytes:
            asked = OwnQuery(request, f"{SERVICES}/{self._sender_name}/{name}")
            take(asked)
            return asked.answer(timeout_s)

        return Urgent(self._keep(self._serve(name, take, server), urgent), ask)

    def _workers_of(self, name: str, handler: UrgentHandler, workers: int) -> Workers[Query]:
        return Workers(
            lambda query: self._answer(name, handler, query), f"the server of {name}", workers, REQUESTS_WAITING
        )

    def _answer(self, name: str, handler: UrgentHandler, query: Query) -> Exception | None:
        """Answer a query; return the error that was its answer."""
        with query:  # dropping it signals the end of replies to the requester
            try:
                request = query.payload
                data, sent_ns = request.to_bytes() if request is not None else b"", sent_of(attachment_of(query))
                reply = handler(data, self._sender(query), sent_ns)
                self._check_size(len(reply), name)
            except Exception as error:  # noqa: BLE001 - passed to the requester
                query.reply_err(f"{type(error).__name__}: {error}", encoding=_FAILED)
                return error
            query.reply(query.key_expr, _sendable(reply), express=True)
            return None

    def _serve(self, name: str, take: Callable[[Query], None], server: Workers[Query]) -> Callable[[], None]:
        key, token = _key(f"{SERVICES}/*", name), _key(SERVED, name).join(uuid.uuid4().hex)
        end = self._declare_server(
            name, key, take,
            lambda: self.connection.declare(lambda session: session.liveliness().declare_token(token)),
        )  # fmt: skip
        return self._keep(end, server)

    def _declare_server(
        self, name: str, key: zenoh.KeyExpr | str, take: Callable[[zenoh.Query], None],
        announce: Callable[[], Callable[[], None]],
    ) -> Callable[[], None]:  # fmt: skip
        """Take the queries of a key, and announce the server, which may exist once; returns a function that ends it."""
        with self._lock:
            if name in self._served:
                raise TransportError(f"{name} already has a server in this process")
            end_queries = self.connection.declare(lambda session: session.declare_queryable(key, take, complete=True))
            self._served.add(name)
        end_token = announce()

        def end() -> None:
            end_token()
            end_queries()
            with self._lock:
                self._served.discard(name)

        return end

    @override
    def request(self, name: str, payload: Payload, timeout_s: float) -> Payload:
        key = _key(f"{SERVICES}/{self._sender_name}", name)
        self._check_size(len(payload), name)
        session = self.connection.session()
        try:
            # Replies go to a channel of this call, so a late reply is discarded.
            replies = session.get(
                key,
                payload=_sendable(payload),
                attachment=sent_now(),
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
            )
        except zenoh.ZError as error:
            raise TransportError(f"{name}: {first_line(error)}") from error
        for reply in replies:
            if (sample := reply.ok) is not None:
                return sample.payload.to_bytes()
            failure = reply.err
            if failure is not None and failure.encoding == _FAILED:
                raise TransportError(f"{name} failed: {failure.payload.to_bytes().decode(errors='replace')}")
            raise TransportError(f"no answer from {name} within {timeout_s} s")
        hint = f"; or its list of robots lacks {self._sender_name!r}" if self.own is not None else ""
        raise TransportError(f"nobody serves {name}, or not any more{hint}")

    @override
    def watch(self, name: str, changed: Callable[[bool], object]) -> Callable[[], None]:
        _key(SERVED, name)  # check the name
        self.connection.check_open()
        return self._keep(*self._presence.watch(name.removeprefix("/"), changed))

    @override
    def served(self, prefix: str) -> frozenset[str]:
        self.connection.check_open()
        return self._presence.served(prefix.removeprefix("/"))

    @override
    def serve_ros(
        self, name: str, kind: ServiceType, handler: RosHandler, *, way: StopWay | None = None,
        check: RosHandler | None = None,
    ) -> Callable[[], None]:  # fmt: skip
        server = RosServer(name, kind, handler, self._log, URGENT_WAITING if way else REQUESTS_WAITING, way)
        if check is not None:
            server.try_out(check)
        key = service_key(self.options.domain, name, kind, hashed=self.options.type_hashes)
        end = self._declare_server(name, key, server.take, lambda: self._announce(name, kind))
        return self._keep(end, server.workers)

    def call_ros(self, name: str, kind: ServiceType, request: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Call a service of a ROS 2 node, under its full name; its response as plain data.

        Raises:
            TransportError: if there is none, or it does not answer within `timeout_s` [s].
            CodecError: if the request does not fit the type.
        """
        key = service_key(self.options.domain, name, kind, hashed=self.options.type_hashes)
        return call(self.connection.session(), key, name, kind, request, timeout_s)

    def _sender(self, query: Query) -> str | None:
        """The sender of a request, from its key: the access list permits only keys of the own name."""
        if not self.connection.knows_who_asks:
            return None
        return str(query.key_expr).removeprefix(f"{SERVICES}/").partition("/")[0]
