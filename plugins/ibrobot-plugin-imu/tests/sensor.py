"""An emulated sensor on a pseudo-terminal, and the bytes that sensors send."""

from __future__ import annotations

import fcntl
import math
import os
import pty
import struct
import termios
import time
import tty
from collections.abc import Callable
from typing import Self

_PATIENCE_S = 10.0


def bno08x(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0, index: int = 0) -> bytes:
    """A message of a BNO08x; angles in degrees."""
    angles = (round(100 * each) for each in (yaw, pitch, roll))
    body = struct.pack("<B3h3h3x", index & 0xFF, *angles, 0, 0, 1000)
    return b"\xaa\xaa" + body + bytes([sum(body) & 0xFF])


def witmotion(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0, kind: int = 0x53) -> bytes:
    """A message of a WitMotion sensor; angles in degrees."""
    angles = (max(-32768, min(32767, round(each / 180 * 32768))) for each in (roll, pitch, yaw))
    body = struct.pack("<BB3hh", 0x55, kind, *angles, 0)
    return body + bytes([sum(body) & 0xFF])


MESSAGES: dict[str, Callable[[float, float, float], bytes]] = {"bno08x": bno08x, "witmotion": witmotion}


class Sensor:
    """A sensor of a model behind a pseudo-terminal, whose path is `port`; a context manager."""

    def __init__(self, model: str) -> None:
        self._message = MESSAGES[model]

    def __enter__(self) -> Self:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        return self

    def __exit__(self, *raised: object) -> None:
        self.unplug()

    def turn(self, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> None:
        """Send an orientation [rad]."""
        self.send(self._message(*(math.degrees(each) for each in (yaw, pitch, roll))))

    def send(self, sent: bytes) -> None:
        """Send any bytes, and wait until they can be read."""
        wanted = self._waiting() + os.write(self._master, sent)
        deadline = time.monotonic() + _PATIENCE_S
        while self._waiting() < wanted:
            assert time.monotonic() < deadline, "the pseudo-terminal passes nothing on"

    def _waiting(self) -> int:
        """Number of bytes to read at the port."""
        return int(struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)))[0])

    def unplug(self) -> None:
        """Remove the port."""
        for end in (self._master, self._slave):
            if end >= 0:
                os.close(end)
        self._master = self._slave = -1
