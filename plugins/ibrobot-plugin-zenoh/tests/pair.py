"""Two connected ends on this machine, for the tests."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

from ibrobot_testing import host_context
from ibrobot_testing.ports import free_port
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import Transport

WAIT_S = 30.0
"""How long a test waits for what must come [s]."""

_numbers = itertools.count()
made: list[ZenohTransport] = []
"""All that a test made: closed after it, however it ended, since open sessions would delay every later test."""


def free_endpoint(protocol: str = "tcp") -> str:
    """An endpoint of this machine that nobody listens on."""
    return f"{protocol}/127.0.0.1:{free_port()}"


def router(endpoint: str, **options: Any) -> ZenohTransport:
    """One that listens at `endpoint`."""
    return make(listen=(endpoint,), mode="router", **options)


def client(endpoint: str, **options: Any) -> ZenohTransport:
    """One that connects to `endpoint`."""
    return make(connect=(endpoint,), **options)


def make(**options: Any) -> ZenohTransport:
    """A transport; without shared memory, whose files Zenoh keeps open after it was closed."""
    return keep(ZenohOptions(**{"shared_memory": False, **options}))


def keep(options: ZenohOptions) -> ZenohTransport:
    """A transport that is closed after the test."""
    made.append(ZenohTransport(options, host_context()))
    return made[-1]


def settle(near: Transport, far: Transport, robot: str = "") -> None:
    """Wait until all that `far` declared is known to `near`: what is declared later becomes known later.

    A robot that is known by name publishes below its name only.
    """
    topic, known = f"{robot}/settle/{next(_numbers)}".strip("/"), threading.Event()
    end = far.subscribe(topic, lambda payload: known.set())
    wait_for(lambda: near.publish(topic, b"") or known.is_set())
    end()


def wait_for(condition: Callable[[], object]) -> None:
    """Ask until `condition` holds; it must within `WAIT_S`."""
    pause = threading.Event()
    for _ in range(int(WAIT_S / 0.005)):
        if condition():
            return
        pause.wait(0.005)
    raise AssertionError("it did not come true")
