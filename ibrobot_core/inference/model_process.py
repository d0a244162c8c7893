"""The model process: loads one policy and runs its `infer` for one robot, until the host ends it or is gone.

Started by `ibrobot_core.inference.process` as `python -m ibrobot_core.inference.model_process PIPE REQUEST ANSWER`,
three inherited descriptors: a pipe for events, and memory for the frames of the wire format, one each way.
"""

from __future__ import annotations

import contextlib
import json
import logging
import mmap
import os
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, override

import attrs

from ibrobot_core.bugs import describe_bug
from ibrobot_core.config import from_document
from ibrobot_core.errors import IbrobotError
from ibrobot_core.inference.build import build_policy
from ibrobot_core.inference.wire import WIRE_LIMITS, WireDecoder, WireEncoder, WireKind, WireMessage
from ibrobot_core.interfaces import Policy
from ibrobot_core.plugins import installed_plugins

_GLANCE_S = 0.5
"""How often to look whether the host is still there."""
_NICE = 5
"""Behind the host, which has cameras to read and a plan to send while the model computes."""


class Events:
    """JSON objects over a pipe, from any thread."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()

    def send(self, event: str, **fields: Any) -> None:
        """Send an event; a host that is gone misses it."""
        with self._lock, contextlib.suppress(OSError):
            self._pipe.send_bytes(json.dumps({"event": event, **fields}).encode())


class _ToHost(logging.Handler):
    """Sends log records to the host, which owns the terminal."""

    def __init__(self, events: Events) -> None:
        super().__init__()
        self._events = events

    @override
    def emit(self, record: logging.LogRecord) -> None:
        self._events.send("log", logger=record.name, level=record.levelno, message=record.getMessage())


def told(error: Exception) -> str:
    """An error in words; a traceback of one that is a bug goes to a file."""
    return str(error) if isinstance(error, IbrobotError) else describe_bug(error)


@attrs.define
class ModelLoop:
    """Answers requests one after the other."""

    policy: Policy
    pipe: Connection
    events: Events
    request: memoryview
    answer: memoryview
    episode: int | None = None
    encoder: WireEncoder = attrs.field(factory=WireEncoder)
    decoder: WireDecoder = attrs.field(factory=WireDecoder)

    def run(self) -> None:
        """Answer until the host hangs up."""
        while True:
            try:
                order = json.loads(self.pipe.recv_bytes())
                while self.pipe.poll():  # nobody waits for the earlier one any more
                    order = json.loads(self.pipe.recv_bytes())
            except (EOFError, OSError):
                return
            self.events.send("answer", id=order["id"], size=self._answered(order["id"], order["size"]))

    def _answered(self, request_id: int, size: int) -> int:
        """Answer the request in memory; returns the size of the answer's frame."""
        begun_ns = time.monotonic_ns()
        try:
            message = self.decoder.decode(self.request[:size])
            if message.episode != self.episode:
                self.policy.reset(message.seed)
                self.episode = message.episode
            outputs = self.policy.infer(message.tensors)
            latency_ms = (time.monotonic_ns() - begun_ns) / 1e6
            return self._put(WireMessage(WireKind.ANSWER, request_id, outputs, latency_ms=latency_ms))
        except Exception as error:  # noqa: BLE001 - contained: one request's fault is its own answer
            return self._put(WireMessage(WireKind.FAILURE, request_id, text=told(error)))

    def _put(self, message: WireMessage) -> int:
        return len(self.encoder.encode(message, lambda size: self.answer[:size]))


def _end_with(host: int) -> None:
    while os.getppid() == host:
        time.sleep(_GLANCE_S)
    os._exit(1)


def main(pipe: int, request: int, answer: int) -> int:
    """Run with the host's pipe and memories; returns the exit status."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the host
    os.nice(_NICE)
    connection = Connection(pipe)
    events = Events(connection)
    root = logging.getLogger("ibrobot")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.addHandler(_ToHost(events))
    policy = None
    try:
        order = json.loads(connection.recv_bytes())
        threading.Thread(target=_end_with, args=(order["host"],), daemon=True).start()
        registry = installed_plugins()
        config = from_document(order["document"], source=Path(order["source"]), sim=order["sim"], registry=registry)
        policy = build_policy(config, registry, order["model"], order["seed"])
        policy.load()
        events.send("ready", fingerprint=policy.fingerprint(), weights=policy.weights())
        frames = [memoryview(mmap.mmap(descriptor, WIRE_LIMITS.size)) for descriptor in (request, answer)]
        ModelLoop(policy, connection, events, frames[0], frames[1]).run()
    except EOFError:
        return 1
    except Exception as error:  # noqa: BLE001 - the host tells it
        events.send("failed", error=told(error))
        return 1
    finally:
        if policy is not None:
            policy.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(*(int(argument) for argument in sys.argv[1:])))
