"""Conventions of rmw_zenoh: names of topics on Zenoh, attachments of messages, and liveliness tokens."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterable

import attrs
from ibrobot_ros2 import type_hash
from ibrobot_ros2.interfaces import ServiceType

from ibrobot_core.api import TransportError

ADMIN = "@ros2_lv"
NO_HASH = "TypeHashNotSupported"
"""ROS 2 Humble's placeholder for the hash of a type."""

HIDDEN = "/_"
"""Part of names that ros2 does not list, e.g. of the services of an action."""
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_ATTACHMENT = struct.Struct("<qqB16s")
_PUBLISHER, _SUBSCRIBER, _SERVER, _CLIENT = "MP", "MS", "SS", "SC"
"""Kinds of endpoints."""
_SEND_GOAL, _OF_ACTION = "/_action/send_goal", "_SendGoal"
_TOKEN_PARTS = 13
_QOS = ":{durability}:,{depth}:,:,:,,"
"""Reliable; empty is the default of each field."""


@attrs.frozen
class SharedTopic:
    """A shared topic: name, message type, and the numbers of publishers and subscribers."""

    name: str
    type: str
    publishers: int
    subscribers: int


@attrs.frozen
class SharedService:
    """A service of ROS 2: name, type, and the numbers of servers and clients."""

    name: str
    type: str
    servers: int
    clients: int


def absolute(topic: str, namespace: str = "") -> str:
    """A topic's full name, e.g. `/robot1/joint_states`.

    Raises:
        TransportError: if it is not a ROS 2 name.
    """
    name = "/" + "/".join(part.strip("/") for part in (namespace, topic) if part.strip("/"))
    if not _NAME.fullmatch(name):
        raise TransportError(f"{topic!r} is not a ROS 2 topic name, e.g. /joint_states")
    return name


def dds_type(ros_type: str) -> str:
    """`sensor_msgs/msg/Image` -> `sensor_msgs::msg::dds_::Image_`."""
    *packages, name = ros_type.split("/")
    return "::".join((*packages, "dds_", f"{name}_"))


def ros_type(dds: str) -> str:
    """`sensor_msgs::msg::dds_::Image_` -> `sensor_msgs/msg/Image`.

    Raises:
        TransportError: if it is not such a name.
    """
    *packages, mark, name = dds.split("::")
    if mark != "dds_" or not packages or not name.endswith("_"):
        raise TransportError(f"{dds!r} is not the name of a message type")
    return "/".join((*packages, name[:-1]))


def typed(type_name: str, *, hashed: bool) -> str:
    """A type as it appears in keys: its DDS name, and its hash."""
    return f"{dds_type(type_name)}/{type_hash(type_name) if hashed else NO_HASH}"


def topic_key(domain: int, topic: str, type_name: str, *, hashed: bool) -> str:
    """The key under which messages of a topic are published."""
    return f"{domain}/{topic.strip('/')}/{typed(type_name, hashed=hashed)}"


def service_key(domain: int, name: str, kind: ServiceType, *, hashed: bool) -> str:
    """The key under which requests to a service are sent."""
    return f"{domain}/{name.strip('/')}/{dds_type(kind.name)}/{kind.hash if hashed else NO_HASH}"


def type_of_key(key: str) -> str:
    """The message type in a topic's key.

    Raises:
        TransportError: if there is none.
    """
    return ros_type(key.rsplit("/", 2)[-2] if key.count("/") > 1 else "")


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """The attachment of a message: its number from 1, time of sending [ns], and the publisher's id (16 bytes)."""
    return _ATTACHMENT.pack(sequence, stamp_ns, len(gid), gid)


def caller_of(attached: bytes) -> tuple[int, bytes]:
    """The number of a request and its client's id (16 bytes), from its attachment; zeros if it has none."""
    if len(attached) != _ATTACHMENT.size:
        return 0, bytes(16)
    number, _, _, gid = _ATTACHMENT.unpack(attached)
    return number, gid


def sent_of(attached: bytes) -> int:
    """When a request was sent, by its client's time of day [ns], from its attachment; 0 if it has none."""
    return int(_ATTACHMENT.unpack(attached)[1]) if len(attached) == _ATTACHMENT.size else 0


@attrs.frozen
class Node:
    """The ROS 2 node that publishes topics.

    Attributes:
        domain: the ROS 2 domain.
        session: Zenoh's id of the session.
        name: the node's name.
    """

    domain: int
    session: str
    name: str

    def node_token(self) -> str:
        """The liveliness token of the node."""
        return f"{ADMIN}/{self.domain}/{self.session}/0/0/NN/%/%/{self.name}"

    def publisher_token(self, number: int, topic: str, type_name: str, *, hashed: bool, latched: bool) -> str:
        """The liveliness token of publisher `number` (from 1) of the node."""
        qos = _QOS.format(durability="1" if latched else "", depth=1 if latched else 10)
        return self._token(number, _PUBLISHER, topic, typed(type_name, hashed=hashed), qos)

    def server_token(self, number: int, name: str, kind: ServiceType, *, hashed: bool) -> str:
        """The liveliness token of the server of a service, the endpoint `number` (from 1) of the node."""
        named = f"{dds_type(kind.name)}/{kind.hash if hashed else NO_HASH}"
        return self._token(number, _SERVER, name, named, _QOS.format(durability="", depth=10))

    def _token(self, number: int, kind: str, name: str, type_name: str, qos: str) -> str:
        mangled = name.replace("/", "%")
        return f"{ADMIN}/{self.domain}/{self.session}/0/{number}/{kind}/%/%/{self.name}/{mangled}/{type_name}/{qos}"


def topics_of_tokens(tokens: Iterable[str]) -> list[SharedTopic]:
    """The topics in liveliness tokens, by name; malformed tokens are ignored."""
    return [SharedTopic(*each) for each in _endpoints(tokens, _PUBLISHER, _SUBSCRIBER)]


def services_of_tokens(tokens: Iterable[str]) -> list[SharedService]:
    """The services in liveliness tokens, by name; malformed tokens are ignored."""
    return [SharedService(*each) for each in _endpoints(tokens, _SERVER, _CLIENT)]


def actions_of(services: Iterable[SharedService]) -> list[tuple[str, str]]:
    """Names and types of the actions among services that have a server."""
    return [
        (each.name.removesuffix(_SEND_GOAL), each.type.removesuffix(_OF_ACTION))
        for each in services
        if each.servers and each.name.endswith(_SEND_GOAL) and each.type.endswith(_OF_ACTION)
    ]


def _endpoints(tokens: Iterable[str], offers: str, uses: str) -> list[tuple[str, str, int, int]]:
    """Name, type, and the numbers of endpoints of two kinds, in liveliness tokens."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for token in set(tokens):  # own tokens may appear twice
        parts = token.split("/")
        if len(parts) == _TOKEN_PARTS and parts[5] in (offers, uses):
            try:
                counts[parts[9].replace("%", "/"), ros_type(parts[10]), parts[5]] += 1
            except TransportError:
                continue
    endpoints = sorted({(name, type_name) for name, type_name, _ in counts})
    return [(name, kind, counts[name, kind, offers], counts[name, kind, uses]) for name, kind in endpoints]
