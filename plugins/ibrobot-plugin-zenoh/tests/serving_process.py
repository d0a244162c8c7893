"""A process that serves `echo`, for tests that kill it: it answers with what it was asked, except to `hang`."""

from __future__ import annotations

import sys
import threading

from ibrobot_testing import host_context
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import Payload


def answer(payload: Payload, _: str | None) -> Payload:
    if payload == b"hang":
        print("asked", flush=True)
        threading.Event().wait()
    return payload


transport = ZenohTransport(ZenohOptions(listen=(sys.argv[1],), mode="router"), host_context())
transport.serve("echo", answer)
print("serving", flush=True)
sys.stdin.read()
