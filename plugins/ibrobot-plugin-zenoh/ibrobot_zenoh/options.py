"""Options of the transport `zenoh`: endpoints to connect to and listen on, and authentication."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import Late, OptionFault, Options, did_you_mean, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot
    from ibrobot_core.app import Component, RunView
    from ibrobot_zenoh.network import Link

MIB = 1024 * 1024
DEFAULT_LISTEN = "tcp/127.0.0.1:7447"
"""Default endpoint of a server."""

_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls|quic|unixsock-stream)/(?P<address>.+)")
_ENCRYPTED = ("tls", "quic")


_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_ROBOT = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def check_robot_name(name: str) -> None:
    """Check that a name can be the namespace of a robot's topics.

    Raises:
        ValueError: if it cannot.
    """
    if not _ROBOT.fullmatch(name):
        raise ValueError(
            f"{name!r} cannot be a robot's name: it is also the namespace of its topics, so use letters, digits and _ "
            "only, e.g. robot1"
        )


def is_local(endpoint: str) -> bool:
    """Whether only this machine can reach an endpoint."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return True
    host = address.rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def server_options(endpoints: Sequence[str]) -> dict[str, Any]:
    """Options of a server that listens at `endpoints`; without any, only on this machine."""
    return {"connect": [], "mode": "router", "listen": list(endpoints) or [DEFAULT_LISTEN]}


def _check_endpoints(instance: object, attribute: attrs.Attribute[tuple[str, ...]], value: tuple[str, ...]) -> None:
    for endpoint in value:
        match = _ENDPOINT.fullmatch(endpoint)
        if match is None:
            raise ValueError(f"{endpoint!r} is not an endpoint; use PROTOCOL/HOST:PORT, e.g. tcp/127.0.0.1:7447")
        port = match["address"].rpartition(":")[2].partition("#")[0]
        if match["protocol"] != "unixsock-stream" and not port.isdecimal():
            raise ValueError(f"{endpoint!r} has no port; use PROTOCOL/HOST:PORT, e.g. {endpoint}:7447")


@documented
@attrs.frozen
class Tls:
    """Certificates, made by `ibrobot certs`; both sides must have one signed by `ca`."""

    ca: Path = option(help="certificate of the authority that signed all certificates")
    certificate: Path = option(help="this machine's certificate")
    key: Path = option(help="private key of this machine")
    robots: Path | None = option(None, help="to listen: a file of admitted robots, one name per line")


def _check_name(what: str, name: str, names: tuple[str, ...]) -> None:
    if not name.startswith("/"):
        raise ValueError(f"{name!r} is not a full {what}, did you mean '/{name}'?")
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not a {what}: it has letters, digits and _ between slashes, and no wildcards")
    if names.count(name) > 1:
        raise ValueError(f"{name} is listed twice")


def _check_topics(instance: Any, attribute: attrs.Attribute[Any], value: tuple[str, ...]) -> None:
    for topic in value:
        _check_name("topic name", topic, value)


def _check_subscribed(
    instance: Any, attribute: attrs.Attribute[Any], value: tuple[str, ...] | Mapping[str, str]
) -> None:
    from ibrobot_core.api import MESSAGE_TYPES

    _check_topics(instance, attribute, tuple(value))
    for topic, type_name in value.items() if isinstance(value, Mapping) else ():
        if type_name not in MESSAGE_TYPES:
            known = did_you_mean(type_name, list(MESSAGE_TYPES), "the types are")
            raise ValueError(f"{topic}: unknown message type {type_name!r}{known}")


def _check_services(instance: Any, attribute: attrs.Attribute[tuple[str, ...]], value: tuple[str, ...]) -> None:
    for service in value:
        alike = [each.removesuffix("/") for each in value if each.endswith("/") == service.endswith("/")]
        _check_name("name of a service", service.removesuffix("/"), tuple(alike))


@documented
@attrs.frozen
class Share:
    """Topics and services shared with other machines."""

    publish: tuple[str, ...] = option(
        (), validator=_check_topics, help="topics of this robot to send, e.g. /joint_states"
    )
    subscribe: tuple[str, ...] | Mapping[str, str] = option(
        (),
        validator=_check_subscribed,
        help="topics of other machines to receive, e.g. [/force_torque]; {/lamp: std_msgs/msg/Bool} declares the type "
        "of a topic that nothing else in this file declares",
    )
    services: tuple[str, ...] = option(
        (),
        validator=_check_services,
        help="services of this robot that others may call, e.g. /planning/go_to; /world/ means all that begin with it. "
        "ROS 2 nodes can call those whose requests std_srvs can say",
    )
    actions: tuple[str, ...] = option(
        (),
        help="executors of this robot that take goals of others, as actions of ROS 2, e.g. arm_trajectory for "
        "/arm_trajectory/follow_joint_trajectory",
    )
    gripper_action: str = option(
        "GripperCommand",
        choices=("GripperCommand", "ParallelGripperCommand"),
        help="type of the action of executors that take a position",
    )
    parameters: bool = option(
        False,
        help="whether others may read this file's values, except secrets, as parameters of the ROS 2 node "
        "ibrobot_NAME; the parameter mode can be set if services has /set_mode",
    )

    def offers(self, service: str) -> bool:
        """Whether other machines may call a service."""
        return any(service == name or (name.endswith("/") and service.startswith(name)) for name in self.services)

    def __attrs_post_init__(self) -> None:
        if both := [topic for topic in self.publish if topic in self.subscribe]:
            raise ValueError(f"{both[0]} is both published and subscribed; it can only go one way")


@documented
@attrs.frozen
class ZenohOptions(Options):
    """Options of `type: zenoh`."""

    share: Share = option(factory=Share, help="topics and services shared with other machines")
    connect: tuple[str, ...] = option(
        (),
        validator=_check_endpoints,
        help="endpoints to connect to, e.g. tls/gpu.lab:7447; a client uses the first that answers, a peer all",
    )
    listen: tuple[str, ...] = option(
        (), validator=_check_endpoints, help="endpoints to listen on, e.g. tcp/127.0.0.1:7447; none by default"
    )
    mode: str = option(
        "client",
        choices=("client", "peer", "router"),
        help="client: only connects; peer: may listen; router: also forwards messages between its clients",
    )
    tls: Tls | None = option(None, help="certificates, for tls and quic endpoints")
    user: str | None = option(None, help="name to connect with, if the other side requires one")
    password: str | None = option(None, secret=True, help="password to connect with, e.g. ${IBROBOT_PASSWORD}")
    users: Path | None = option(None, help="file of robots that may connect, as lines NAME:PASSWORD")
    trusted_network: bool = option(
        False, help="allow listening beyond this machine without tls or users: everyone there has all permissions"
    )
    settings: Path | None = option(
        None, help="JSON5 file of Zenoh's own settings; its access_control replaces the built-in one"
    )
    max_message_size: int = option(
        64 * MIB, unit="bytes", ge=1024, help="larger messages are neither sent nor accepted"
    )
    lease: float = option(2.0, unit="s", ge=0.2, le=60, help="silence after which a connection counts as lost")
    shared_memory: bool = option(True, help="use shared memory for large messages to processes on this machine")
    domain: int = option(0, ge=0, le=232, help="ROS 2 domain of shared topics")
    namespace: str | None = option(
        None,
        help="prefix of shared topics, e.g. robot1 for /robot1/joint_states; by default a robot's name "
        "in its certificate, or its user name",
    )
    type_hashes: bool = option(True, help="false: without type hashes, as in ROS 2 Humble")

    def __attrs_post_init__(self) -> None:
        if self.mode == "client" and self.listen:
            raise ValueError("a client does not listen; set mode: router (or peer) to listen")
        if self.mode == "client" and not self.connect:
            raise ValueError(
                "needs endpoints to connect to, e.g. connect: [tcp/127.0.0.1:7447]; or mode: router and listen"
            )
        if self.share.actions and not self.listen and (self.tls is not None or self.user is not None):
            raise ValueError(
                "share.actions: a server that knows robots by name lets none of them take goals of others; give goals "
                "to a run that listens itself"
            )
        for endpoint in (*self.connect, *self.listen):
            encrypted = endpoint.partition("/")[0] in _ENCRYPTED
            if encrypted and self.tls is None:
                raise ValueError(f"{endpoint} needs tls: {{ca: …, certificate: …, key: …}}; `ibrobot certs` makes them")
            if not encrypted and self.tls is not None and not is_local(endpoint):
                raise ValueError(f"{endpoint} would not use tls; write tls/{endpoint.partition('/')[2]}")
        if (self.user is None) != (self.password is None):
            raise ValueError("set both user and password, or neither")
        if self.user is not None:
            check_robot_name(self.user)
        if not (self.trusted_network or self.tls or self.users):
            for endpoint in self.listen:
                if not is_local(endpoint):
                    raise ValueError(
                        f"listen: {endpoint} can be reached by other machines: set tls or users, or "
                        "trusted_network: true if everyone may have all permissions"
                    )
        if not re.fullmatch(r"(/?[A-Za-z_][A-Za-z0-9_]*)*", self.namespace or ""):
            raise ValueError(f"namespace {self.namespace!r} is not a ROS 2 name, e.g. robot1 or lab/robot1")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the files in the self exist."""
        files: dict[tuple[str, ...], Path | None] = {("settings",): self.settings, ("users",): self.users}
        if self.tls is not None:
            files |= {("tls", name): path for name, path in attrs.asdict(self.tls).items()}
        for key, path in files.items():
            if path is not None and not path.is_file():
                yield OptionFault(key, f"no such file: {path}")

    def publishes(self) -> list[tuple[tuple[str | int, ...], str]]:
        """The topics of other machines, each with its key in the self."""
        topics = self.share.subscribe
        keys: Iterable[str | int] = topics if isinstance(topics, Mapping) else range(len(topics))
        return [(("share", "subscribe", key), topic) for key, topic in zip(keys, topics, strict=True)]

    def offers(self, service: str) -> bool:
        """Whether other machines may call a service."""
        return self.share.offers(service)

    @property
    def used(self) -> bool:
        """Whether it shares anything."""
        return self.share != Share()

    def components(self, run: RunView, link: Link) -> Sequence[Component]:
        """What shares topics, services and actions."""
        shared: Sequence[Component] = Late("ibrobot_zenoh.sharing:components")(self.share, run, link)
        return shared
