"""Topics of a run for other machines, and theirs for it. The bus never waits for the transport."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from typing import override

from ibrobot_core.api import NS_PER_S, IbrobotError, Message, did_you_mean
from ibrobot_core.app import Component, RunView, SessionWorker, Subscription
from ibrobot_zenoh.network import Link, transport_of

_DEPTH = 10
"""Queue size of a topic for the network; when it is full, the bus drops and counts the oldest message."""
_SILENT_NS = 5 * NS_PER_S
"""A topic without a message for this long after the start is reported, once [ns]."""


class PublishedTopic(SessionWorker):
    """Sends a topic of the bus to other machines. Messages that cannot be sent are skipped and reported once."""

    def __init__(self, session: RunView, link: Link, topic: str) -> None:
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

    def __init__(self, session: RunView, link: Link, topics: Collection[str] | Mapping[str, str]) -> None:
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
