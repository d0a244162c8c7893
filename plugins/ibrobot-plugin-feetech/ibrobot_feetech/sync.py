"""The bus traffic of every tick: a sync read of all servos and a sync write of their goals, prepared in advance."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ibrobot_feetech import protocol
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.protocol import OVERHEAD
from ibrobot_feetech.registers import STS3215, Register, register, writable

_HEADER = 5
"""Bytes of a reply before its parameters."""


class Replies(NamedTuple):
    """The servos' replies to a sync read, in the order in which they were asked."""

    decoded: list[int]
    """Register values, servo by servo, S x R of them; 0 where a reply is missing."""
    answered: NDArray[np.bool_]
    """Shape (S,)."""
    errors: NDArray[np.uint8]
    """The error byte of each reply, shape (S,)."""
    complete: bool
    """Whether all servos answered and none reports an error."""

    @property
    def values(self) -> NDArray[np.intp]:
        """`decoded` as an array, shape (S, R)."""
        return np.array(self.decoded).reshape(len(self.answered), -1)


class SyncReader:
    """Reads the registers from `first` to `last` of all servos in one request.

    A complete answer is checked and decoded as one array; otherwise the bus parses it packet by packet.

    Args:
        bus: an open bus.
        servos: the ids, in the order of the result.
        first: the first register.
        last: the last register; the result includes all registers in between, see `registers`.
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
        count = len(self._servos)
        self._unpack = struct.Struct("<" + _layout(inside, self._address, self._size) * count).unpack
        self._signs = [1 << (r.sign_bit if r.sign_bit is not None else 8 * r.size) for r in inside] * count
        length = OVERHEAD + self._size
        self._expected = count * length
        self._bodies = [(start + 2, start + length) for start in range(0, self._expected, length)]
        self._mask, self._pattern = self._frame()
        self._everyone = np.ones(count, dtype=np.bool_)
        self._no_errors = np.zeros(count, dtype=np.uint8)
        self._timeout_ms = math.ceil(bus.timeout(len(self._request), self._expected, count) * 1e3)

    def read(self, again_until: float = 0.0) -> Replies:
        """Ask all servos and return the replies that arrive in time.

        Args:
            again_until: until this time (`time.monotonic`) [s], servos without a valid reply are asked again, once.

        Raises:
            PortError: if the port is gone.
        """
        bus = self._bus
        if bus.outstanding:
            return self._slowly(bus.sync_read_span(self._address, self._size, self._servos), again_until)
        bus.begin_request()
        received = bus.port.exchange(self._request, self._expected, self._timeout_ms)
        # Compare headers, ids, lengths and error bytes of all replies as one large integer; then the checksums.
        if len(received) == self._expected and int.from_bytes(received) & self._mask == self._pattern:
            for start, end in self._bodies:
                if sum(received[start:end]) & 0xFF != 0xFF:
                    break
            else:
                return Replies(self._decode(received), self._everyone, self._no_errors, True)
        replies = bus.sync_replies(received, self._request, self._servos, self._size, 0, self._size)
        return self._slowly(replies, again_until)

    def _frame(self) -> tuple[int, int]:
        """Mask and pattern of the bytes that a valid answer must have."""
        one = b"\xff" * _HEADER + b"\x00" * (self._size + 1)
        pattern = b"".join(
            protocol.HEADER + bytes((servo, self._size + 2, 0)) + b"\x00" * (self._size + 1) for servo in self._servos
        )
        return int.from_bytes(one * len(self._servos)), int.from_bytes(pattern)

    def _decode(self, received: bytes) -> list[int]:
        return [
            -(raw & (sign - 1)) if raw & sign else raw & (sign - 1)
            for raw, sign in zip(self._unpack(received), self._signs, strict=False)
        ]

    def _slowly(self, replies: dict[int, tuple[bytes, int]], again_until: float) -> Replies:
        missing = [servo for servo in self._servos if servo not in replies]
        if missing and time.monotonic() < again_until:
            self._bus.counters["retries"] += 1
            replies |= self._bus.sync_read_span(self._address, self._size, missing)
        answered = np.array([servo in replies for servo in self._servos])
        errors = np.array([replies[servo][1] if servo in replies else 0 for servo in self._servos], dtype=np.uint8)
        blank = b"\x00" * self._size
        contents = [replies[servo][0] if servo in replies else blank for servo in self._servos]
        received = b"".join(b"\x00" * _HEADER + content + b"\x00" for content in contents)
        return Replies(self._decode(received), answered, errors, bool(answered.all() and not errors.any()))


class SyncWriter:
    """Writes one register of all servos in one request, which no servo answers.

    Args:
        bus: an open bus.
        servos: the ids, in the order of the values.
        name: the register.
    """

    def __init__(self, bus: FeetechBus, servos: Sequence[int], name: str = "goal_position") -> None:
        self._bus = bus
        self._servos = tuple(servos)
        self._register = target = writable(name)
        self._interleaved = [0] * (2 * len(self._servos))
        self._interleaved[::2] = self._servos
        self._pack = struct.Struct("<" + ("BH" if target.size == 2 else "BB") * len(self._servos)).pack
        example = protocol.sync_write(target.address, {servo: bytes(target.size) for servo in self._servos})
        self._head = example[: -1 - len(self._servos) * (1 + target.size)]
        self._head_sum = sum(self._head[2:])
        self._greatest = target.limits[1]

    def write(self, values: Sequence[int] | NDArray[np.integer]) -> None:
        """Send the values, one for each servo.

        Raises:
            PortError: if the port is gone.
            ValueError: if a value is out of range.
        """
        numbers = values.tolist() if isinstance(values, np.ndarray) else values
        if min(numbers) < 0 or max(numbers) > self._greatest:
            encode = self._register.encode
            numbers = [int.from_bytes(encode(value), "little") for value in numbers]
        self._interleaved[1::2] = numbers
        body = self._pack(*self._interleaved)
        self._bus.counters["requests"] += 1
        self._bus.port.write(self._head + body + bytes((~(self._head_sum + sum(body)) & 0xFF,)))


def _layout(registers: Sequence[Register], address: int, size: int) -> str:
    """The `struct` format of a reply's registers."""
    layout, at = f"{_HEADER}x", address
    for entry in registers:
        layout += f"{entry.address - at}x" + ("H" if entry.size == 2 else "B")
        at = entry.address + entry.size
    return layout + f"{address + size - at + 1}x"
