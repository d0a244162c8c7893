"""Messages on Zenoh, under the names and with the encoding of ROS 2 nodes that use rmw_zenoh."""

from __future__ import annotations

import re
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any, override

import zenoh
import zenoh.ext
from ibrobot_ros2 import decode, encode
from ibrobot_ros2.interfaces import ServiceType
from ibrobot_ros2.workers import Workers

from ibrobot_core.api import Context, IbrobotError, Message, TransportError
from ibrobot_zenoh.connection import Connection, Declared, first_line
from ibrobot_zenoh.identity import Role, own_identity
from ibrobot_zenoh.network import TopicTransport
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.ros2 import (
    ADMIN,
    Node,
    SharedService,
    SharedTopic,
    absolute,
    attachment,
    services_of_tokens,
    topic_key,
    topics_of_tokens,
    type_of_key,
)

DEPTH = 100
"""Queue size of a subscriber; when it is full, the oldest message is dropped."""
_LIST_S = 2.0
"""How long to wait for the names on a network, unless the caller says [s]."""
_AGAIN_S = 0.02
_LARGE = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
"""Types of large messages; smaller ones may overtake them."""


class _Publisher:
    """A published topic. If latched, its newest message is also sent to later subscribers, and after connecting."""

    def __init__(self, transport: RosTransport, topic: str, type_name: str, *, latched: bool) -> None:
        self.type_name = type_name
        self.latched = latched
        self._transport = transport
        self._topic = topic
        self._gid = uuid.uuid4().bytes
        self._lock = threading.Lock()
        self._sequence = 0
        self._newest: bytes | None = None
        self._publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher | None = None
        transport.connection.declare(self._declare)

    def publish(self, payload: bytes) -> None:
        with self._lock:
            if self._publisher is not None:
                self._put(self._publisher, payload)
            elif self.latched:
                self._newest = payload

    @property
    def is_heard(self) -> bool:
        """Whether there is a subscriber; False without a connection."""
        if not isinstance(self._publisher, zenoh.Publisher):
            return False
        status: Any = self._publisher.matching_status  # its stub says bool
        return bool(status.matching)

    def _put(self, publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher, payload: bytes) -> None:
        self._sequence += 1
        try:
            publisher.put(payload, attachment=attachment(self._sequence, time.time_ns(), self._gid))
        except zenoh.ZError as error:
            raise TransportError(f"{self._topic}: {first_line(error)}") from error

    def _declare(self, session: zenoh.Session) -> Declared:
        options = self._transport.options
        hashed = options.type_hashes
        key = topic_key(options.domain, self._topic, self.type_name, hashed=hashed)
        qos: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.BLOCK,
            "priority": zenoh.Priority.DATA_LOW if self.type_name in _LARGE else zenoh.Priority.DATA,
        }
        publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        if self.latched:
            cache = zenoh.ext.CacheConfig(max_samples=1)
            publisher = zenoh.ext.declare_advanced_publisher(session, key, cache=cache, publisher_detection=True, **qos)
        else:
            publisher = session.declare_publisher(key, **qos)
        token = self._transport.node(session).publisher_token(
            self._transport.next_number(), self._topic, self.type_name, hashed=hashed, latched=self.latched
        )
        self._token = session.liveliness().declare_token(token)
        with self._lock:
            self._publisher = publisher
            if self._newest is not None:
                self._put(publisher, self._newest)
        return publisher


class RosTransport(TopicTransport):
    """The half of the transport that ROS 2 nodes take part in: publishes and receives messages, and lists names.

    Raises:
        TransportError: as `Connection`.

    Attributes:
        options: the options.
        connection: the session.
        own: identity of this machine; None if it has none.
    """

    def __init__(self, options: ZenohOptions, ctx: Context) -> None:
        self.options = options
        self.own = own_identity(options)
        self.connection = Connection(options, ctx.log)
        default = self.own.name if self.own is not None and self.own.role is Role.ROBOT else ""
        self._namespace = default if options.namespace is None else options.namespace
        self._log = ctx.log
        self._name = "ibrobot_" + re.sub(r"\W", "_", ctx.robot.name)
        self._lock = threading.Lock()
        self._publishers: dict[str, _Publisher] = {}
        self._workers: set[Workers[Any]] = set()
        self._number = 0
        self._is_known = False
        """Whether ROS 2 nodes see this node."""

    @property
    @override
    def node_name(self) -> str:
        return absolute(self._name, self.namespace)

    @property
    @override
    def namespace(self) -> str:
        return self._namespace

    @override
    def publish_message(self, topic: str, message: Message, *, latched: bool = False) -> None:
        name = absolute(topic, self.namespace)
        if self.own is not None:
            self.own.check_may_publish(name)
        self.publish_cdr(name, message.ros_type, encode(message).tobytes(), latched=latched)

    @override
    def publish_cdr(self, name: str, type_name: str, payload: bytes, *, latched: bool = False) -> None:
        self.connection.check_open()
        self._check_size(len(payload), name)
        publisher = self._publisher(name, type_name, latched=latched)
        if publisher.type_name != type_name:
            raise TransportError(f"topic {name} carries {publisher.type_name}, not {type_name}")
        publisher.publish(payload)

    def _check_size(self, size: int, name: str) -> None:
        if size > (limit := self.options.max_message_size):
            raise TransportError(f"{name}: a message of {size} bytes is larger than max_message_size, {limit}")

    def is_heard(self, topic: str, type_name: str, timeout_s: float) -> bool:
        """Whether a topic of a type has a subscriber; waits up to `timeout_s` [s] for one."""
        publisher = self._publisher(absolute(topic, self.namespace), type_name, latched=False)
        deadline = time.monotonic() + timeout_s
        while not publisher.is_heard and time.monotonic() + _AGAIN_S < deadline:
            time.sleep(_AGAIN_S)
        return publisher.is_heard

    def _publisher(self, name: str, type_name: str, *, latched: bool) -> _Publisher:
        with self._lock:
            publisher = self._publishers.get(name)
            if publisher is None:
                self._be_known()
                publisher = self._publishers[name] = _Publisher(self, name, type_name, latched=latched)
            return publisher

    def _be_known(self) -> None:
        """Declare the node, once; called with the lock held."""
        if not self._is_known:
            self._is_known = True
            self.connection.declare(lambda session: session.liveliness().declare_token(self.node(session).node_token()))

    def _announce(self, name: str, kind: ServiceType) -> Callable[[], None]:
        """Show the server of a service to ROS 2 nodes; returns a function that ends it."""
        with self._lock:
            self._be_known()
        hashed = self.options.type_hashes
        return self.connection.declare(
            lambda session: session.liveliness().declare_token(
                self.node(session).server_token(self.next_number(), name, kind, hashed=hashed)
            )
        )

    @override
    def subscribe_messages(self, topic: str, callback: Callable[[Message], object]) -> Callable[[], None]:
        name = absolute(topic, self.namespace)
        return self.subscribe_cdr(name, lambda type_name, data: callback(decode(type_name, data)))

    def subscribe_cdr(self, name: str, callback: Callable[[str, bytes], object]) -> Callable[[], None]:
        """As `subscribe_messages`, with the type and the bytes of each message, under its full name."""
        warned: set[str] = set()

        def warn_once(text: str, *arguments: object) -> None:
            if text not in warned:
                warned.add(text)
                self._log.warning(text, *arguments)

        def deliver(sample: zenoh.Sample) -> None:
            try:
                callback(type_of_key(str(sample.key_expr)), sample.payload.to_bytes())
            except IbrobotError as error:
                warn_once("a message on %s was skipped: %s", name, error)

        subscriber = Workers(deliver, f"a subscriber of {name}", depth=DEPTH)

        def take(sample: zenoh.Sample) -> None:
            if subscriber.put(sample) is not None:
                warn_once("a subscriber of %s is too slow: messages are dropped", name)

        key = f"{self.options.domain}{name}/*/*"
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        end = self.connection.declare(
            lambda session: zenoh.ext.declare_advanced_subscriber(session, key, take, history=history)
        )
        return self._keep(end, subscriber)

    def shared_topics(self, timeout_s: float = _LIST_S) -> list[SharedTopic]:
        """All shared topics, by name; waits up to `timeout_s` [s] for the answer.

        Raises:
            TransportError: if closed or not connected.
        """
        return topics_of_tokens(self._settled_tokens(timeout_s))

    def shared_services(self, timeout_s: float = _LIST_S) -> list[SharedService]:
        """The services of ROS 2 nodes, by name; waits up to `timeout_s` [s] for the answer.

        Raises:
            TransportError: if closed or not connected.
        """
        return services_of_tokens(self._settled_tokens(timeout_s))

    def _settled_tokens(self, timeout_s: float) -> set[str]:
        deadline = time.monotonic() + timeout_s
        tokens, before = self._tokens(timeout_s), None
        # The first answer after connecting may arrive before the other side has sent all its tokens.
        while tokens != before and time.monotonic() + _AGAIN_S < deadline:
            time.sleep(_AGAIN_S)
            tokens, before = self._tokens(timeout_s), tokens
        return tokens

    def _tokens(self, timeout_s: float) -> set[str]:
        replies = self.connection.session().liveliness().get(f"{ADMIN}/{self.options.domain}/**", timeout=timeout_s)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def node(self, session: zenoh.Session) -> Node:
        """The node of the publishers on `session`."""
        return Node(self.options.domain, str(session.info.zid()), self._name)

    def next_number(self) -> int:
        """A number for a publisher, from 1."""
        self._number += 1  # always under the connection's lock
        return self._number

    @override
    def close(self) -> None:
        with self._lock:
            workers, self._workers = self._workers, set()
        for each in workers:
            each.end()
        self.connection.close()

    def _keep(self, end_declared: Callable[[], None], workers: Workers[Any]) -> Callable[[], None]:
        """Have `close` end workers; returns a function that ends them, and what feeds them."""
        with self._lock:
            self._workers.add(workers)

        def end() -> None:
            end_declared()
            workers.end()
            with self._lock:
                self._workers.discard(workers)

        return end
