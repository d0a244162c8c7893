"""Shares topics and services between a run and other machines. The bus never waits for the transport."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from typing import Any, override

import attrs
from ibrobot_ros2.interfaces import ServiceType
from ibrobot_ros2.services import (
    DETAILS,
    SERVICES,
    Answer,
    Call,
    decode_answer,
    decode_call,
    encode_answer,
    encode_call,
    endpoint,
)
from ibrobot_ros2.workers import StopWay

from ibrobot_core.api import (
    NS_PER_S,
    IbrobotError,
    Message,
    NotSupported,
    Payload,
    Transport,
    TransportError,
    did_you_mean,
)
from ibrobot_core.app import (
    CHECK_ESTOP,
    ESTOP,
    Component,
    GoalRun,
    RunView,
    SessionWorker,
    Subscription,
    TransportLink,
    described,
    type_name,
)
from ibrobot_zenoh.arrivals import Arrivals
from ibrobot_zenoh.options import Share

type UrgentHandler = Callable[[Payload, str | None, int], Payload]
"""As `Handler`; the last argument is when the request was sent, by the sender's time of day [ns], 0 if unknown."""
type RosHandler = Callable[[dict[str, Any], Reply], object]
_DEPTH = 10
"""Queue size of a topic for the network; when it is full, the bus drops and counts the oldest message."""

_MOST_BYTES = 1 << 20
"""Largest request to a service [bytes]."""
_URGENT_BYTES = 1000
"""Largest request to an urgent service [bytes]."""
_CHECK_S = 10.0
"""Longest wait for the answer to a stop that is only tried [s]."""
_SILENT_NS = 5 * NS_PER_S
"""A topic without a message for this long after the start is reported, once [ns]."""


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


def components(share: Share, session: GoalRun, link: TransportLink) -> list[Component]:
    """The components that share the topics and services in a YAML.

    Raises:
        NotSupported: if it subscribes to topics of other machines, or serves them, in lockstep.
        MissingDependency: if it publishes topics of a sensor that cannot run on this machine.
    """
    if session.request.lockstep and share.subscribe:
        raise NotSupported("transport.share.subscribe: a lockstep run cannot receive topics of other machines")
    if session.request.lockstep and (share.services or share.parameters):
        raise NotSupported("transport.share.services: a lockstep run cannot answer other machines")
    if session.request.lockstep and share.actions:
        raise NotSupported("transport.share.actions: a lockstep run cannot take goals of other machines")
    from ibrobot_zenoh.ros_parameters import RosParameters
    from ibrobot_zenoh.ros_sharing import RosSharing

    session.refuse_absent("transport.share.publish", share.publish.__contains__)
    arrivals = Arrivals(session)
    subscribed: list[Component] = [SubscribedTopics(session, link, share.subscribe)] if share.subscribe else []
    served: list[Component] = []
    if share.services:
        served.append(SharedServices(session, link, share, arrivals))
    if share.parameters:
        served.append(RosParameters(session, link, share.offers, arrivals))
    if share.actions or share.services:
        served.append(RosSharing(session, link, share, arrivals))
    return [*(PublishedTopic(session, link, topic) for topic in share.publish), *subscribed, *served]


def transport_of(link: TransportLink) -> TopicTransport:
    """The transport of a link, which carries messages."""
    transport = link.transport
    assert isinstance(transport, TopicTransport)
    return transport


class PublishedTopic(SessionWorker):
    """Sends a topic of the bus to other machines. Messages that cannot be sent are skipped and reported once."""

    def __init__(self, session: RunView, link: TransportLink, topic: str) -> None:
        super().__init__(session, f"share:{topic}", "to other machines", (link.name,))
        self._link = link
        self._topic = topic
        self._subscription: Subscription | None = None
        self._reported = False
        self._silent_from_ns: int | None = None

    @override
    def setup(self) -> None:
        self._transport = transport_of(self._link)
        self._silent_from_ns = self.session.clock.now_ns()
        self._subscription = self.session.bus.subscribe(self._topic, _DEPTH)

    @override
    def work(self, timeout_s: float) -> None:
        assert self._subscription is not None
        received = self._subscription.get(timeout_s)
        if received is not None:
            self._silent_from_ns = None
        elif self._silent_from_ns is not None and self.session.clock.now_ns() - self._silent_from_ns > _SILENT_NS:
            self._silent_from_ns = None
            known = did_you_mean(self._topic, list(self.session.bus.topics()), "topics here")
            self.session.log.warning("%s is not shared: it has no publisher so far%s", self._topic, known)
        while received is not None:
            self._send(received.message)
            received = self._subscription.get()

    def _send(self, message: Message) -> None:
        try:
            self._transport.publish_message(self._topic, message, latched=self._topic in self.session.bus.latched())
        except IbrobotError as error:
            if not self._reported:
                self._reported = True
                self.session.log.warning("%s is not shared: %s", self._topic, error)

    @override
    def teardown(self) -> None:
        if self._subscription is not None:
            self._subscription.close()


class SubscribedTopics(Component):
    """Forwards topics of other machines to the bus."""

    def __init__(self, session: RunView, link: TransportLink, topics: Collection[str] | Mapping[str, str]) -> None:
        super().__init__("share", f"{', '.join(topics)} from other machines", (link.name,))
        self._link = link
        self._session = session
        self._topics = topics
        self._ends = ExitStack()

    @override
    def start(self) -> None:
        transport, bus = transport_of(self._link), self._session.bus
        for topic, carried in self._topics.items() if isinstance(self._topics, Mapping) else ():
            bus.expect(topic, carried)
        for topic in self._topics:
            if not bus.expected(topic):
                self._session.log.warning(
                    "transport.share.subscribe: nothing declares the type of %s, so its first message will; "
                    "{%s: TYPE} declares it",
                    topic,
                    topic,
                )
            self._ends.callback(transport.subscribe_messages(topic, self._to_bus(topic)))

    def _to_bus(self, topic: str) -> Callable[[Message], None]:
        reported = False

        def take(message: Message) -> None:
            nonlocal reported
            try:
                self._session.bus.publish(topic, message)
            except IbrobotError as error:
                if not reported:
                    reported = True
                    self._session.log.warning("from another machine: %s", error)

        return take

    @override
    def stop(self) -> None:
        self._ends.close()


class SharedServices(Component):
    """Answers calls of the bus's services from other machines.

    A name that ends with / means all services whose names begin with it. `/rosapi/services` lists the services,
    and `/rosapi/service_request_details` describes one.
    """

    def __init__(self, session: RunView, link: TransportLink, share: Share, arrivals: Arrivals) -> None:
        super().__init__("share:services", f"{', '.join(share.services)} for other machines", (link.name,))
        self._session = session
        self._link = link
        self._share = share
        self._arrivals = arrivals
        self._way = StopWay(session, "services for other machines")
        self._ends = ExitStack()

    def _offers(self, name: str) -> bool:
        return self._share.offers(ESTOP.name if name == CHECK_ESTOP.name else name)

    @override
    def start(self) -> None:
        transport = transport_of(self._link)
        name = endpoint(transport.namespace)
        served = transport.serve_with_urgent(name, self._answer, self._is_urgent, _MOST_BYTES, self._way)
        self._ends.callback(served.end)
        self._way.open()
        self._ends.callback(self._way.close)
        if self._offers(ESTOP.name):
            answer = decode_answer(served.ask(encode_call(Call(CHECK_ESTOP.name)), _CHECK_S))
            if not answer.result:
                raise TransportError(f"an emergency stop by {name} would fail: {answer.values}")

    @override
    def stop(self) -> None:
        self._ends.close()

    def _is_urgent(self, payload: Payload) -> bool:
        """Whether a request is for an urgent service. It delays all other requests, so only short ones are read."""
        if len(payload) > _URGENT_BYTES:
            return False
        try:
            service = self._session.bus.services().get(decode_call(payload).service)
        except IbrobotError:
            return False
        return service is not None and service.urgent

    def _answer(self, payload: Payload, sender: str | None, sent_ns: int) -> bytes:
        call = None
        try:
            call = decode_call(payload)
            if call.service == SERVICES:
                return encode_answer(Answer(self._shared()))
            name = str(call.request) if call.service == DETAILS else call.service
            if not self._offers(name):
                raise NotSupported(
                    f"{name} is not shared{did_you_mean(name, self._shared(), 'shared')};"
                    " transport.share.services of the robot lists what is"
                )
            if call.service == DETAILS:
                return encode_answer(Answer(self._details(name)))
            self._arrivals.check(name, sent_ns)
            return encode_answer(Answer(self._session.bus.call(name, call.request)))
        except IbrobotError as error:
            return encode_answer(Answer(str(error), result=False))
        except Exception as error:
            if call is None or call.service == ESTOP.name:
                self._way.lose(error)
            self._session.log.exception("a service failed")
            return encode_answer(Answer("the service failed; the robot's log has the cause", result=False))

    def _details(self, name: str) -> dict[str, Any]:
        """The declaration of a service, as JSON values."""
        service = self._session.bus.services().get(name)
        if service is None:
            raise NotSupported(f"nothing serves {name} at present; served are {', '.join(self._shared())}")
        keys = {"request": service.request, "answer_keys": service.answer}
        tables = {
            name: [attrs.asdict(key) for key in described(kind)] if isinstance(kind, type) and attrs.has(kind) else []
            for name, kind in keys.items()
        }
        return {"help": service.help, "alone": service.alone, "answer": type_name(service.answer), **tables}

    def _shared(self) -> list[str]:
        """The shared services that are served at present."""
        return [name for name in self._session.bus.services() if self._offers(name)]
