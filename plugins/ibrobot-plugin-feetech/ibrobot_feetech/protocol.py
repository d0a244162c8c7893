"""Packets of the Feetech STS bus: packing, parsing, and finding them in a byte stream."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum

import attrs

HEADER = b"\xff\xff"
BROADCAST = 0xFE
MAX_ID = 0xFD
OVERHEAD = 6
"""Bytes of a packet without its parameters: header, id, length, code, checksum."""
MAX_PARAMETERS = 0xFF - 2 - 1
"""One less than the length byte allows, because length 0xFF could be mistaken for a header."""


class Instruction(IntEnum):
    """Instructions in packets from the host."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    """A write that waits for `ACTION`; the emulator knows both."""
    ACTION = 0x05
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


OVERLOAD, OVER_CURRENT = 0x20, 0x08
"""Bits of a status packet's error byte that persist until the torque is switched off."""
FAULTS: Mapping[int, str] = {0: "voltage", 1: "angle sensor", 2: "overheating", 3: "over-current", 5: "overload"}
"""Bit of a status packet's error byte -> meaning."""


@attrs.frozen
class Packet:
    """A packet. `code` is the instruction in packets from the host, and the error byte in those from a servo."""

    servo: int
    code: int
    parameters: bytes = b""


def checksum(body: bytes | bytearray) -> int:
    """The checksum of the bytes between header and checksum."""
    return ~sum(body) & 0xFF


def pack(packet: Packet) -> bytes:
    """The bytes of a packet.

    Raises:
        ValueError: if id, code or number of parameters are out of range.
    """
    if not 0 <= packet.servo <= BROADCAST:
        raise ValueError(f"servo id must be 0 to {MAX_ID}, or {BROADCAST} for all, not {packet.servo}")
    if not 0 <= packet.code <= 0xFF:
        raise ValueError(f"code must be a byte, not {packet.code}")
    if len(packet.parameters) > MAX_PARAMETERS:
        raise ValueError(f"a packet has at most {MAX_PARAMETERS} parameters, not {len(packet.parameters)}")
    body = bytes((packet.servo, len(packet.parameters) + 2, packet.code)) + packet.parameters
    return HEADER + body + bytes((checksum(body),))


def ping(servo: int) -> bytes:
    """Ask a servo to answer."""
    return pack(Packet(servo, Instruction.PING))


def read(servo: int, address: int, size: int) -> bytes:
    """Ask for `size` bytes from `address`."""
    return pack(Packet(servo, Instruction.READ, bytes((address, size))))


def write(servo: int, address: int, content: bytes) -> bytes:
    """Set bytes from `address`."""
    return pack(Packet(servo, Instruction.WRITE, bytes((address,)) + content))


def sync_read(servos: Iterable[int], address: int, size: int) -> bytes:
    """Ask several servos for the same registers; they answer in turn."""
    return pack(Packet(BROADCAST, Instruction.SYNC_READ, bytes((address, size, *_distinct(servos)))))


def sync_write(address: int, contents: Mapping[int, bytes]) -> bytes:
    """Set the same registers of several servos; no servo answers.

    Args:
        address: the first register.
        contents: servo id -> bytes, of equal length.
    """
    sizes = {len(content) for content in contents.values()}
    if len(sizes) != 1:
        raise ValueError(f"sync write needs the same number of bytes for all servos, not {sorted(sizes)}")
    each = b"".join(bytes((servo,)) + contents[servo] for servo in _distinct(contents))
    return pack(Packet(BROADCAST, Instruction.SYNC_WRITE, bytes((address, *sizes)) + each))


def _distinct(servos: Iterable[int]) -> Sequence[int]:
    ids = tuple(servos)
    if not ids or len(set(ids)) != len(ids) or not all(0 <= servo <= MAX_ID for servo in ids):
        raise ValueError(f"servo ids must be distinct, each 0 to {MAX_ID}, and at least one, not {list(ids)}")
    return ids


def faults(code: int) -> tuple[str, ...]:
    """The names of the bits set in an error byte."""
    return tuple(FAULTS.get(bit, f"unknown error bit {bit}") for bit in range(8) if code >> bit & 1)


class Scanner:
    """Finds packets in a stream with garbage; after an invalid packet it skips one byte and searches again."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.discarded = 0
        """Number of bytes dropped so far because they did not belong to a packet."""
        self.damaged = 0
        """Number of packets with a wrong checksum."""

    def feed(self, received: bytes) -> list[Packet]:
        """Add bytes; returns complete packets and keeps an incomplete one for the next call."""
        self._buffer += received
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def finish(self) -> list[Packet]:
        """The packets within the remaining bytes, which looked like an incomplete packet, at the end of the stream."""
        packets = []
        while self._buffer:
            self._drop(1)
            packets += self.feed(b"")
        return packets

    def _next(self) -> Packet | None:
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                self._drop(len(buffer) - buffer.endswith(b"\xff"))
                return None
            self._drop(start)
            if len(buffer) < 4:
                # With three ff in a row, the first is not a header, because ff is not a valid id.
                if buffer[2:3] == b"\xff":
                    self._drop(1)
                    continue
                return None
            end = buffer[3] + 4
            if buffer[2] == 0xFF or not 2 <= buffer[3] <= MAX_PARAMETERS + 2:
                self._drop(1)
            elif len(buffer) < end:
                return None
            elif buffer[end - 1] != checksum(buffer[2 : end - 1]):
                self.damaged += 1
                self._drop(1)
            else:
                packet = Packet(buffer[2], buffer[4], bytes(buffer[5 : end - 1]))
                del buffer[:end]
                return packet

    def _drop(self, count: int) -> None:
        self.discarded += count
        del self._buffer[:count]
