"""The bus traffic of every tick: one sync read of all servos, one sync write of their goals, prepared beforehand."""

from __future__ import annotations

import time
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_feetech import protocol
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.protocol import OVERHEAD
from ibrobot_feetech.registers import STS3215, Register, register

_HEADER = 5
"""Bytes of a reply before its parameters."""


@attrs.frozen(eq=False)
class Replies:
    """What the servos answered to one sync read, in the order in which they were asked."""

    answered: NDArray[np.bool_]
    """Shape (S,)."""
    values: NDArray[np.int32]
    """Decoded registers, shape (S, R); meaningless where `answered` is False."""
    errors: NDArray[np.uint8]
    """The error byte of each reply, shape (S,)."""


class SyncReader:
    """Reads the registers `first` to `last` of all servos, in one request and without retries.

    A good answer is checked and decoded as one array; anything else goes through the bus, packet by packet.

    Args:
        bus: an open bus.
        servos: the ids, in the order of the result.
        first: the first register.
        last: the last; every register between them is in the result, see `registers`.
    """

    def __init__(self, bus: FeetechBus, servos: Sequence[int], first: str, last: str | None = None) -> None:
        self._bus = bus
        self._servos = tuple(servos)
        begin, end = register(first), register(last or first)
        inside = [r for r in STS3215.values() if begin.address <= r.address <= end.address]
        self.registers = tuple(r.name for r in inside)
        """The columns of `Replies.values`."""
        self._address = begin.address
        self._size = end.address + end.size - begin.address
        self._request = protocol.sync_read(self._servos, self._address, self._size)
        self._dtype = _reply_type(inside, self._address, self._size)
        signs = [1 << r.sign_bit if r.sign_bit is not None else 0 for r in inside]
        self._signs = np.array(signs, dtype=np.int32)
        self._magnitudes = np.array([s - 1 if s else (1 << 8 * r.size) - 1 for s, r in zip(signs, inside, strict=True)])
        count = len(self._servos)
        self._expected = count * (OVERHEAD + self._size)
        self._mask, self._pattern = self._frame()
        self._everyone = np.ones(count, dtype=np.bool_)
        self._timeout_s = bus.timeout(len(self._request), self._expected, count)

    def read(self) -> Replies:
        """Ask all servos and take what comes in time.

        Raises:
            PortError: when the port is gone.
        """
        bus = self._bus
        if bus.any_late:
            return self._slowly(bus.sync_read_span(self._address, self._size, self._servos))
        bus.begin_request()
        bus.port.write(self._request)
        received = bus.port.read(self._expected, time.monotonic() + self._timeout_s)
        # Headers, ids and lengths all at once, as one great number; then all checksums.
        if len(received) == self._expected and int.from_bytes(received) & self._mask == self._pattern:
            raw = np.frombuffer(received, dtype=np.uint8).reshape(len(self._servos), -1)
            if (raw[:, 2:].sum(axis=1, dtype=np.uint8) == 0xFF).all():
                return self._decode(received, self._everyone, raw[:, 4])
        return self._slowly(bus.sync_replies(received, self._request, self._servos, self._size, 0, self._size))

    def _frame(self) -> tuple[int, int]:
        """Mask and pattern of the bytes that are known beforehand in a good answer."""
        one = b"\xff\xff\xff\xff\x00" + b"\x00" * (self._size + 1)
        pattern = b"".join(
            protocol.HEADER + bytes((servo, self._size + 2, 0)) + b"\x00" * (self._size + 1) for servo in self._servos
        )
        return int.from_bytes(one * len(self._servos)), int.from_bytes(pattern)

    def _decode(self, received: bytes, answered: NDArray[np.bool_], errors: NDArray[np.uint8]) -> Replies:
        fields = np.frombuffer(received, dtype=self._dtype)
        values = np.empty((len(self._servos), len(self.registers)), dtype=np.int32)
        for column, name in enumerate(self.registers):
            values[:, column] = fields[name]
        magnitude = values & self._magnitudes
        return Replies(answered, np.where(values & self._signs, -magnitude, magnitude).astype(np.int32), errors)

    def _slowly(self, found: dict[int, tuple[bytes, int]]) -> Replies:
        answered = np.array([servo in found for servo in self._servos])
        errors = np.array([found[servo][1] if servo in found else 0 for servo in self._servos], dtype=np.uint8)
        blank = b"\x00" * self._size
        contents = [found[servo][0] if servo in found else blank for servo in self._servos]
        received = b"".join(b"\x00" * _HEADER + content + b"\x00" for content in contents)
        return self._decode(received, answered, errors)


class SyncWriter:
    """Writes one register of all servos in one request, which none answers.

    Args:
        bus: an open bus.
        servos: the ids, in the order of the values.
        name: the register.
    """

    def __init__(self, bus: FeetechBus, servos: Sequence[int], name: str = "goal_position") -> None:
        self._bus = bus
        self._servos = tuple(servos)
        self._register = register(name)

    def write(self, values: Sequence[int] | NDArray[np.integer]) -> None:
        """Send the values, one for each servo.

        Raises:
            PortError: when the port is gone.
            ValueError: for a value that the register cannot hold.
        """
        self._bus.counters["requests"] += 1
        encode = self._register.encode
        contents = {servo: encode(int(value)) for servo, value in zip(self._servos, values, strict=True)}
        self._bus.port.write(protocol.sync_write(self._register.address, contents))


def _reply_type(registers: Sequence[Register], address: int, size: int) -> np.dtype[np.void]:
    return np.dtype(
        {
            "names": [r.name for r in registers],
            "formats": ["<u2" if r.size == 2 else "u1" for r in registers],
            "offsets": [_HEADER + r.address - address for r in registers],
            "itemsize": OVERHEAD + size,
        }
    )
