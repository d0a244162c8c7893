"""Feeds a service with damaged frames and its port with garbage, while a real robot asks it.

    python plugins/ibrobot-plugin-serve/tests/fuzz_wire.py --mutants 5000000 --connections 2000

Every answer to a mutant must be a frame, nothing may be raised, the process must not grow, and the robot must get its
own outputs throughout. The connections need ibrobot-plugin-zenoh; `--connections 0` leaves them out. Exits with 1 when
anything of this fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import random
import resource
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import override

import numpy as np
from ibrobot_serve.remote import RemoteEngine
from ibrobot_serve.service import InferenceService
from ibrobot_serve.wire import WireDecoder, WireEncoder, WireKind, WireMessage, service_name
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy, FakeTransport
from ibrobot_testing.ports import free_port

from ibrobot_core.api import Handler, Tensors, Transport
from ibrobot_core.app import installed_plugins

GROWTH_MIB = 64
"""What the process may grow by: threads' stacks and arenas, and the counts of 256 robots."""
WAIT_NS = 10_000_000_000
INTERESTING = (0, 1, 7, 8, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)


class Adds(FakePolicy):
    """Adds one; whatever it cannot add to fails alone."""

    def __init__(self) -> None:
        super().__init__(host_context())

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return {"sum": np.add(tensors["state"], tensors["one"])}


class Tapped(FakeTransport):
    """Keeps the handlers, so that mutants need no thread of their own."""

    def __init__(self) -> None:
        super().__init__()
        self.handlers: dict[str, Handler] = {}

    @override
    def serve(self, name: str, handler: Handler, *, workers: int = 16) -> Callable[[], None]:
        self.handlers[name] = handler
        return super().serve(name, handler, workers=workers)


class Robot(threading.Thread):
    """Asks for a sum again and again; `wrong` says what was not as it should be."""

    def __init__(self, transport: Transport) -> None:
        super().__init__(daemon=True)
        self._engine = RemoteEngine(Adds(), transport, "adds", "real")
        self.served = 0
        self.wrong: list[str] = []
        self.slowest_s = 0.0
        self.stopped = threading.Event()

    @override
    def run(self) -> None:
        self._engine.start()
        while not self.stopped.wait(0.01):
            state, begun_s = np.arange(6.0) + self.served, time.monotonic()
            try:
                outputs = self._engine.infer(
                    {"state": state, "one": np.ones(6)}, self.served, time.monotonic_ns() + WAIT_NS
                )
                if not np.array_equal(outputs["sum"], state + 1):
                    raise ValueError(f"got {outputs['sum']} for {state}")
            except Exception as error:  # noqa: BLE001 - reported at the end
                self.wrong.append(f"{type(error).__name__}: {error}")
            self.slowest_s = max(self.slowest_s, time.monotonic() - begun_s)
            self.served += 1
        self._engine.close()


def seeds(fingerprint: str) -> list[bytes]:
    """Whole frames to damage."""
    state, one = np.arange(6.0), np.ones(6)
    asked = WireMessage(
        WireKind.REQUEST, 3, {"state": state, "one": one}, "fuzz", fingerprint, deadline_ns=50_000_000, episode=1
    )
    picture = WireMessage(
        WireKind.REQUEST,
        4,
        {"top": np.zeros((4, 4, 3), np.uint8), "on": np.array([True])},
        "fuzz",
        fingerprint,
        deadline_ns=50_000_000,
    )
    return [
        bytes(WireEncoder().encode(m))
        for m in (asked, picture, WireMessage(WireKind.FAILURE, 9, text="no"), WireMessage(WireKind.ANSWER, 1))
    ]


def mutant(chance: random.Random, frames: list[bytes]) -> bytes:
    """A frame, damaged once to four times."""
    frame = bytearray(chance.choice(frames))
    for _ in range(chance.choice((1, 1, 2, 4))):
        at = chance.randrange(max(1, min(len(frame), 320)))
        match chance.randrange(7):
            case 0:
                frame[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                frame[at : at + 1] = bytes([(frame[at] if at < len(frame) else 0) ^ (1 << chance.randrange(8))])
            case 2:
                form = chance.choice("BHIQ")
                size = struct.calcsize(form)
                frame[at : at + size] = struct.pack(f"<{form}", chance.choice(INTERESTING) % 2 ** (8 * size))
            case 3:
                del frame[at : at + chance.randrange(1, 70)]
            case 4:
                frame[at:at] = chance.randbytes(chance.randrange(1, 70))
            case 5:
                other = chance.choice(frames)
                frame[at:] = other[at:]
            case 6:
                del frame[chance.randrange(len(frame) + 1) :]
    if len(frame) >= 64 and chance.random() < 0.5:
        struct.pack_into("<Q", frame, 56, len(frame))  # so that damage gets past the first check
    return bytes(frame)


def memory_mib() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def fuzz_frames(count: int, seed: int) -> tuple[Counter[str], Robot, float]:
    """Feed mutants to a service; what its answers were, the robot, and the growth [MiB]."""
    transport = Tapped()
    service = InferenceService(Adds(), transport, "adds")
    service.start()
    robot = Robot(transport)
    robot.start()
    chance, ended = random.Random(seed), Counter[str]()
    frames, handler = seeds(Adds().fingerprint()), transport.handlers[service_name("adds")]
    for number in range(count):
        if number == min(count // 10, 100_000):
            before_mib = memory_mib()
        answer = WireDecoder().decode(handler(mutant(chance, frames), None))
        ended["answered" if answer.kind is WireKind.ANSWER else "malformed" if answer.id == 0 else "failed"] += 1
    grown = memory_mib() - before_mib
    robot.stopped.set()
    robot.join()
    service.close()
    transport.close()
    return ended, robot, grown


def fuzz_connections(count: int, seed: int) -> tuple[Robot, float]:
    """Open connections that send garbage to a listening server; the robot, and the growth [MiB]."""
    descriptor = installed_plugins().find("transport", "zenoh")
    address = ("127.0.0.1", free_port())
    endpoint = f"tcp/127.0.0.1:{address[1]}"
    server = descriptor.make(descriptor.options(mode="router", listen=(endpoint,)), host_context())
    service = InferenceService(Adds(), server, "adds")
    service.start()
    client = descriptor.make(descriptor.options(connect=(endpoint,)), host_context())
    robot = Robot(client)
    robot.start()
    chance, before_mib = random.Random(seed), memory_mib()
    opened: list[socket.socket] = []
    for _ in range(count):
        connection = socket.create_connection(address, 5.0)
        connection.settimeout(0.05)
        with contextlib.suppress(OSError):  # it may well hang up at once
            connection.sendall(chance.randbytes(chance.choice((1, 3, 100, 5000, 70000))))
        opened.append(connection)
        if len(opened) > 20:  # some stay open and silent
            opened.pop(chance.randrange(len(opened))).close()
    for connection in opened:
        connection.close()
    asked = robot.served
    while robot.served < asked + 20:
        time.sleep(0.05)
    grown = memory_mib() - before_mib
    robot.stopped.set()
    robot.join()
    service.close()
    for transport in (client, server):
        transport.close()
    return robot, grown


def main() -> int:
    """Print what came of it as JSON; 1 when it is not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--mutants", type=int, default=100_000)
    parser.add_argument("--connections", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    np.seterr(all="ignore")  # sums of damaged numbers
    begun_s = time.monotonic()
    ended, robot, grown = fuzz_frames(arguments.mutants, arguments.seed)
    summary = {
        "mutants": arguments.mutants,
        **ended,
        "growth_mib": round(grown, 1),
        "robot_served": robot.served,
        "robot_slowest_ms": round(robot.slowest_s * 1e3, 1),
        "robot_wrong": robot.wrong[:3],
        "seconds": round(time.monotonic() - begun_s),
    }
    wrong = bool(robot.wrong) or grown > GROWTH_MIB or not robot.served
    print(json.dumps(summary), flush=True)
    if arguments.connections:
        robot, grown = fuzz_connections(arguments.connections, arguments.seed)
        summary = {
            "garbage_connections": arguments.connections,
            "growth_mib": round(grown, 1),
            "robot_served": robot.served,
            "robot_slowest_ms": round(robot.slowest_s * 1e3, 1),
            "robot_wrong": robot.wrong[:3],
        }
        wrong = wrong or bool(robot.wrong) or grown > GROWTH_MIB
        print(json.dumps(summary))
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
