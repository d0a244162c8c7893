"""A network that remembers what is published."""

from __future__ import annotations

import threading

import attrs
from ibrobot_testing.fakes import FakeTransport
from ibrobot_zenoh.network import TopicTransport, Urgent
from ibrobot_zenoh.options import Share
from ibrobot_zenoh.sharing import components

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import TransportDescriptor
from ibrobot_core.errors import TransportError
from ibrobot_core.options import option


@attrs.frozen
class NetworkOptions(Options):
    share: Share = option(factory=Share)

    @property
    def used(self):
        return self.share != Share()

    def components(self, run, link):
        return components(self.share, run, link)


class Network(FakeTransport, TopicTransport):
    def __init__(self):
        super().__init__()
        self.sent, self.callbacks, self.refuses, self.goes_on = [], {}, False, threading.Event()
        self.goes_on.set()
        self.closed = False
        self.sent_ns = 0

    def publish_message(self, topic, message, *, latched=False):
        self.goes_on.wait(60)
        if self.refuses:
            raise TransportError("the network says no")
        self.sent.append((topic, message, latched))

    def subscribe_messages(self, topic, callback):
        self.callbacks[topic] = callback
        return lambda: self.callbacks.pop(topic)

    def serve_with_urgent(self, name, handler, is_urgent, largest, way):
        self.is_urgent = is_urgent
        end = self.serve(name, lambda request, sender: handler(request, sender, self.sent_ns))
        return Urgent(end, lambda request, timeout_s: handler(request, None, 0))

    def publish_cdr(self, name, type_name, payload, *, latched=False):
        self.sent.append((name, type_name, latched))

    def serve_ros(self, name, kind, handler, *, way=None, check=None):
        return lambda: None

    def close(self):
        super().close()
        self.closed = True


MADE: list[Network] = []


def make(options, ctx):
    MADE.append(Network())
    return MADE[-1]


@hookimpl
def ibrobot_transports():
    yield TransportDescriptor(
        "network",
        make,
        "a network",
        NetworkOptions,
    )
