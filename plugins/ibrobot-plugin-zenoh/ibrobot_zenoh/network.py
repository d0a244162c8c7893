"""What sharing needs of a network: messages, services and actions under the names of ROS 2."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import attrs
from ibrobot_ros2.interfaces import ServiceType
from ibrobot_ros2.workers import StopWay

from ibrobot_core.api import Message, Payload, Transport

type UrgentHandler = Callable[[Payload, str | None, int], Payload]
"""As `Handler`; the last argument is when the request was sent, by the sender's time of day [ns], 0 if unknown."""
type RosHandler = Callable[[dict[str, Any], Reply], object]


@attrs.frozen
class Urgent:
    """Served urgent requests."""

    end: Callable[[], None]
    """Ends it."""
    ask: Callable[[bytes, float], bytes]
    """The answer to an urgent request that comes from here, by the queue and threads of those that come from others.

    Args: the request, and the longest wait [s]. Raises TransportError if there is no answer.
    """


@attrs.frozen
class Reply:
    """Answers a call with plain data: call it, once."""

    send: Callable[[Mapping[str, Any]], None]
    sent_ns: int = 0
    """When the call was sent, by the caller's time of day [ns]; 0 if that is unknown."""

    def __call__(self, response: Mapping[str, Any]) -> None:
        """Answer."""
        self.send(response)


class TopicTransport(Transport):
    """A transport that also carries messages, between the buses of several machines."""

    @abstractmethod
    def publish_message(self, topic: str, message: Message, *, latched: bool = False) -> None:
        """Send a message to all subscribers of `topic`; later subscribers get the newest message of a latched topic.

        It may wait for the network, so call it from a dedicated thread.

        Raises:
            TransportError: if closed, or the topic has another type.
            IbrobotError: if the message cannot be sent.
        """

    @abstractmethod
    def subscribe_messages(self, topic: str, callback: Callable[[Message], object]) -> Callable[[], None]:
        """Call `callback` with every message on `topic`, of any type; returns a function that unsubscribes.

        Unreadable messages are skipped, with a warning.

        Raises:
            TransportError: if closed.
        """

    @abstractmethod
    def serve_with_urgent(
        self, name: str, handler: UrgentHandler, is_urgent: Callable[[Payload], bool], largest: int, way: StopWay
    ) -> Urgent:
        """Like `serve`; urgent requests have their own queue and threads, so that no other request delays them.

        Requests of more than `largest` bytes are refused at once, so that they cannot fill the memory. An exception in
        `is_urgent`, or in `handler` for an urgent request, loses the `way`.
        """

    @property
    def node_name(self) -> str:
        """The full name of this process's node in ROS 2."""
        return "/ibrobot"

    @property
    def namespace(self) -> str:
        """Prefix of this robot's names on the network."""
        return ""

    @abstractmethod
    def publish_cdr(self, name: str, type_name: str, payload: bytes, *, latched: bool = False) -> None:
        """As `publish_message`, with the bytes of a message of any type, under its full name."""

    @abstractmethod
    def serve_ros(
        self, name: str, kind: ServiceType, handler: RosHandler, *, way: StopWay | None = None,
        check: RosHandler | None = None,
    ) -> Callable[[], None]:  # fmt: skip
        """Answer the calls that ROS 2 nodes make of a service, under its full name; returns a function that ends it.

        Args:
            name: the full name.
            kind: its type.
            handler: called in a thread with the request, as plain data, and a function to answer it with plain data,
                now or later, in any thread.
            way: for urgent services: they are answered beside others, in threads that exist from now on.
            check: called once, now, in place of `handler`, by the queue and a thread of calls that come from others;
                it answers whether a call would work, as `success` and `message`.

        Raises:
            TransportError: if closed, or there is a server of this name, or `check` fails.
        """


class Link(Protocol):
    """The run's transport, for components that need `name`: it is open when they start."""

    name: str

    @property
    def transport(self) -> Transport:
        """The transport, from its start to its stop."""


def transport_of(link: Link) -> TopicTransport:
    """The transport of a link, which carries messages."""
    transport = link.transport
    assert isinstance(transport, TopicTransport)
    return transport
