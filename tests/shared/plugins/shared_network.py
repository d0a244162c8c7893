"""A transport that all ends in this process share."""

from __future__ import annotations

from ibrobot_testing.fakes import FakeTransport

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import TransportDescriptor


class Shared(FakeTransport):
    """One for the robot and its server."""

    def close(self):
        pass


NETWORK = Shared()


@hookimpl
def ibrobot_transports():
    yield TransportDescriptor("shared", lambda options, ctx: NETWORK, "a network")
