"""Messages of orientation sensors: bytes in, angles out. Damaged and foreign bytes are counted and left out.

Sources: BNO08X datasheet (CEVA), "UART-RVC"; WitMotion's manuals, output protocol.
"""

from __future__ import annotations

import math
import struct
from abc import ABC, abstractmethod
from typing import ClassVar, override

import attrs

_HALF_TURN, _QUARTER_TURN = 180.0, 90.0


@attrs.frozen
class Angles:
    """An orientation: turns about x by `roll`, then y by `pitch`, then z by `yaw`, fixed axes [rad]."""

    yaw: float
    pitch: float
    roll: float


class MessageReader(ABC):
    """Finds messages in a stream of bytes that may begin anywhere and may be damaged.

    Attributes:
        refused: number of bytes that belonged to no valid message.
    """

    header: ClassVar[bytes]
    size: ClassVar[int]

    def __init__(self) -> None:
        self.refused = 0
        self._rest = b""

    def feed(self, received: bytes) -> list[Angles]:
        """The orientations in the bytes received so far that were not returned yet, in order."""
        stream, at = self._rest + received, 0
        readings: list[Angles] = []
        while True:
            begin = stream.find(self.header, at)
            if begin < 0:
                # The last bytes may be the beginning of a header.
                begin = max(at, len(stream) - len(self.header) + 1)
            self.refused += begin - at
            at = begin
            message = stream[at : at + self.size]
            if len(message) < self.size:
                self._rest = stream[at:]
                return readings
            if not self._is_valid(message):
                self.refused += 1
                at += 1
                continue
            at += self.size
            if (angles := self._angles(message)) is not None:
                readings.append(angles)

    def forget(self) -> None:
        """Drop an incomplete message."""
        self._rest = b""

    @abstractmethod
    def _is_valid(self, message: bytes) -> bool:
        """Whether `size` bytes that begin with `header` are a message."""

    @abstractmethod
    def _angles(self, message: bytes) -> Angles | None:
        """The orientation in a valid message; None if it has none."""


class Bno08xReader(MessageReader):
    """BNO08x in UART-RVC mode: 19 bytes at 100 Hz.

    0xAA 0xAA, an index, yaw, pitch and roll [0.01 degree], accelerations along x, y and z [mg], each int16
    little-endian, three reserved bytes, and the sum of all bytes after the header.
    """

    header = b"\xaa\xaa"
    size = 19

    @override
    def _is_valid(self, message: bytes) -> bool:
        return sum(message[2:18]) & 0xFF == message[18] and _are_angles(*self._degrees(message))

    @override
    def _angles(self, message: bytes) -> Angles:
        return Angles(*map(math.radians, self._degrees(message)))

    def _degrees(self, message: bytes) -> tuple[float, float, float]:
        yaw, pitch, roll = struct.unpack_from("<3h", message, 3)
        return yaw / 100, pitch / 100, roll / 100


class WitMotionReader(MessageReader):
    """WitMotion sensors: messages of 11 bytes; those of type 0x53 have angles.

    0x55, the type, four int16 little-endian, and the sum of all bytes before. Type 0x53 has roll, pitch and yaw in
    units of 180 / 32768 degrees, and the version. Times (0x50), accelerations (0x51), angular rates (0x52) and the
    others up to 0x5f are left out.
    """

    header = b"\x55"
    size = 11

    @override
    def _is_valid(self, message: bytes) -> bool:
        known = message[1] & 0xF0 == 0x50 and sum(message[:10]) & 0xFF == message[10]
        return known and (message[1] != 0x53 or _are_angles(*self._degrees(message)))

    @override
    def _angles(self, message: bytes) -> Angles | None:
        return Angles(*map(math.radians, self._degrees(message))) if message[1] == 0x53 else None

    def _degrees(self, message: bytes) -> tuple[float, float, float]:
        roll, pitch, yaw = (each * 180 / 32768 for each in struct.unpack_from("<3h", message, 2))
        return yaw, pitch, roll


READERS: dict[str, type[MessageReader]] = {"bno08x": Bno08xReader, "witmotion": WitMotionReader}
"""Model -> reader of its messages."""


def _are_angles(yaw: float, pitch: float, roll: float) -> bool:
    return abs(yaw) <= _HALF_TURN and abs(pitch) <= _QUARTER_TURN and abs(roll) <= _HALF_TURN
