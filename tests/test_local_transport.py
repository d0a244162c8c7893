"""The local transport passes the suite, and a subscriber's fault is logged."""

from __future__ import annotations

import queue
import threading
from typing import override

import pytest
from ibrobot_testing import TransportSuite, host_context

from ibrobot_core.interfaces import Context, Transport
from ibrobot_core.local_transport import LocalTransport
from ibrobot_core.plugins import discover


class TestLocalTransport(TransportSuite):
    @override
    def make(self, ctx: Context) -> Transport:
        descriptor = discover([]).find("transport", "local")
        transport: Transport = descriptor.make(descriptor.options(), ctx)
        return transport


def test_a_failing_subscriber_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    transport = LocalTransport()
    taken: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def failing(payload: bytes) -> None:
        if payload == b"bad":
            raise ValueError("cannot read this")
        taken.put(payload)

    transport.subscribe("topic", failing)
    for payload in (b"bad", b"good"):
        transport.publish("topic", payload)
    assert taken.get(timeout=30) == b"good"
    transport.close()
    assert "a subscriber of topic failed" in caplog.text
    assert "cannot read this" in caplog.text


def test_a_subscriber_may_end_itself() -> None:
    transport = TestLocalTransport().make(host_context())
    arrived: list[bytes] = []
    done = threading.Event()

    def once(payload: bytes) -> None:
        arrived.append(payload)
        end()
        done.set()

    end = transport.subscribe("topic", once)
    transport.publish("topic", b"1")
    transport.publish("topic", b"2")
    assert done.wait(30)
    transport.close()
    assert arrived == [b"1"]
