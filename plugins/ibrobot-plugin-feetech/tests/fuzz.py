"""Damages replies at random and sees that the bus raises nothing but its own errors, and never hangs.

    python plugins/ibrobot-plugin-feetech/tests/fuzz.py --mutations 5000000

Requests go to a port in memory, which answers as servos would and then flips, cuts, inserts, repeats, swaps and delays
bytes; nothing waits. Prints how many exchanges there were and how they ended.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import sys
import time
from collections import Counter
from functools import partial

from ibrobot_feetech import protocol
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.errors import FeetechError, Place, PortError
from ibrobot_feetech.port import SerialPort
from ibrobot_feetech.protocol import BROADCAST, Instruction, Packet
from ibrobot_feetech.sync import SyncReader, SyncWriter

SERVOS = (1, 2, 3, 4, 5, 6)
POSITION = 0x07D0
"""What every register pair says, so that a wrong value shows."""


class MemoryPort(SerialPort):
    """A port whose other end damages what it answers."""

    def __init__(self, chance: random.Random) -> None:
        super().__init__("memory", 1_000_000)
        self._chance = chance
        self._coming = b""
        self._kept = b"\xff\xff"
        self.mutations = 0

    def open(self) -> None:
        pass

    def write(self, request: bytes) -> None:
        self._coming += self._damaged(self._answer(request))

    def read(self, size: int, deadline: float) -> bytes:
        if self._chance.random() < 0.001:
            raise PortError(Place(self.path), "the port is gone")
        count = self._chance.choice((size, size, size + 3, 1, 7))
        received, self._coming = self._coming[:count], self._coming[count:]
        return received

    def exchange(self, request: bytes, size: int, timeout_ms: int) -> bytes:
        self.write(request)
        return self.read(size, 0.0)

    def discard(self) -> int:
        if self._chance.random() < 0.5:
            return 0  # these come only now: late replies
        count, self._coming = len(self._coming), b""
        return count

    def _answer(self, request: bytes) -> bytes:
        servo, code, parameters = request[2], request[4], request[5:-1]
        filling = POSITION.to_bytes(2, "little") * 128
        if code == Instruction.SYNC_READ:
            return b"".join(protocol.pack(Packet(i, 0, filling[: parameters[1]])) for i in parameters[2:])
        if code == Instruction.SYNC_WRITE or (servo == BROADCAST and code != Instruction.PING):
            return b""
        content = filling[: parameters[1]] if code == Instruction.READ else b""
        ids = SERVOS if servo == BROADCAST else (servo,)
        return b"".join(protocol.pack(Packet(i, 0, content)) for i in ids)

    def _damaged(self, answer: bytes) -> bytes:
        chance, reply = self._chance, bytearray(answer)
        for _ in range(chance.choice((0, 1, 1, 2, 3, 6))):
            self.mutations += 1
            at = chance.randrange(len(reply) + 1)
            kind = chance.randrange(8)
            if kind == 0 and reply:
                reply[at % len(reply)] ^= 1 << chance.randrange(8)
            elif kind == 1 and reply:
                reply[at % len(reply)] = chance.choice((0, 1, 2, 0xFD, 0xFE, 0xFF, chance.randrange(256)))
            elif kind == 2:
                del reply[at : at + chance.randrange(1, 5)]
            elif kind == 3:
                reply[at:at] = chance.randbytes(chance.randrange(1, 9))
            elif kind == 4:
                del reply[at:]
            elif kind == 5:
                reply[at:at] = reply[at : at + chance.randrange(1, 20)]
            elif kind == 6:
                reply[at:at] = self._kept
            else:
                self._kept = bytes(reply)[:40] or b"\xff"
        return bytes(reply)


def fuzz(mutations: int, seed: int) -> Counter[str]:
    """Exchange until so many mutations were made; returns how the exchanges ended."""
    port = MemoryPort(random.Random(seed))
    bus = FeetechBus("memory", retries=1)
    bus.port = port
    bus.resynchronise = bus.outstanding.clear  # type: ignore[method-assign]  # which would wait for what never comes
    fast = SyncReader(bus, SERVOS, "present_position", "present_load")
    long = SyncReader(bus, SERVOS, "present_position", "present_current")
    writer = SyncWriter(bus, SERVOS)
    requests = (
        fast.read,
        long.read,
        fast.read,
        partial(bus.read, 2, "present_position"),
        partial(bus.read, 6, "present_voltage"),
        partial(bus.read_faulty, 3, "status"),
        partial(bus.write, 4, "goal_position", POSITION),
        partial(bus.sync_read, "present_position", SERVOS),
        partial(bus.scan, SERVOS),
        partial(writer.write, [POSITION] * 6),
    )
    ended: Counter[str] = Counter()
    while port.mutations < mutations:
        if bus.port._chance.random() < 0.1:
            bus.outstanding.clear()  # as after half a second
        try:
            requests[bus.port._chance.randrange(len(requests))]()
            ended["answered"] += 1
        except FeetechError as error:
            ended[type(error).__name__] += 1
    ended["mutations"] = port.mutations
    return ended


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutations", type=int, default=5_000_000)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    begun = time.monotonic()
    share = -(-arguments.mutations // (arguments.jobs * 10))
    with multiprocessing.Pool(arguments.jobs) as pool:
        results = pool.starmap(fuzz, [(share, seed) for seed in range(arguments.jobs * 10)], chunksize=1)
    total = sum(results, Counter())
    print(json.dumps({**total, "took_s": round(time.monotonic() - begun, 1)}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
