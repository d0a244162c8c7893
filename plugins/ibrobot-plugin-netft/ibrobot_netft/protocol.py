"""Packets of ATI's raw data transfer, RDT (Net F/T manual 9620-05-NET FT, section 9): UDP, big-endian."""

from __future__ import annotations

import struct

import attrs

from ibrobot_core.api import SensorError

PORT = 49152
HEADER = 0x1234
STOP, START = 0, 2
"""Commands: end the stream; stream in real time."""
_REQUEST = struct.Struct(">HHI")
_RECORD = struct.Struct(">III6i")
ERROR_BITS = 0xFFFF0000
"""Bits of the status that mean that the values are wrong, e.g. a saturated gauge or a broken cable; the others warn."""


def request(command: int) -> bytes:
    """The packet that starts a stream without end, or ends it."""
    return _REQUEST.pack(HEADER, command, 0)


def command_of(data: bytes) -> int | None:
    """The command in a packet that a sensor receives; None if it is no request."""
    if len(data) != _REQUEST.size:
        return None
    header, command, _ = _REQUEST.unpack(data)
    return int(command) if header == HEADER else None


@attrs.frozen
class Record:
    """One measurement."""

    sequence: int
    """Number of the record in this stream, from 1."""
    sample: int
    """Number of the sensor's own sample."""
    status: int
    counts: tuple[int, int, int, int, int, int]
    """Force along x, y and z, and torque about them."""

    def encode(self) -> bytes:
        """The packet."""
        return _RECORD.pack(self.sequence, self.sample, self.status, *self.counts)

    @classmethod
    def decode(cls, data: bytes) -> Record:
        """The record in a packet.

        Raises:
            SensorError: if it has another length.
        """
        if len(data) != _RECORD.size:
            raise SensorError(f"a record has {_RECORD.size} bytes, not {len(data)}")
        sequence, sample, status, *counts = _RECORD.unpack(data)
        return cls(sequence, sample, status, tuple(counts))
