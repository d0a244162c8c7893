"""`ibrobot netft emulate`: a force-torque sensor on a loopback port."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, echo, on_signals
from ibrobot_netft.protocol import START, STOP, Record, command_of

_NOTHING = (0, 0, 0, 0, 0, 0)


class EmulatedNetFt:
    """A sensor that answers one program at a time; a context manager.

    Args:
        port: UDP port on the loopback interface; 0 for a free one.
    """

    def __init__(self, port: int = 0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.05)
        self._listener: tuple[str, int] | None = None
        self._sequence = 0
        self._ended = threading.Event()
        self._asked = threading.Event()
        self.stopped = threading.Event()
        """Set once a program has ended the stream."""
        self._thread = threading.Thread(target=self._serve, name="emulated force sensor", daemon=True)
        self.silent = False
        """Whether it is without power or cable."""

    @property
    def port(self) -> int:
        """Its UDP port."""
        return int(self._socket.getsockname()[1])

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()

    def wait(self, timeout_s: float) -> bool:
        """Wait until a program has asked for the stream, up to `timeout_s` [s]; returns whether it has."""
        return self._asked.wait(timeout_s)

    def measure(self, counts: Sequence[int] = _NOTHING, status: int = 0, sequence: int | None = None) -> None:
        """Send a record, as the sensor does at its rate; its number is the next unless `sequence` is given."""
        if self._listener is None or self.silent:
            return
        self._sequence += 1
        number = self._sequence if sequence is None else sequence
        x, y, z, around_x, around_y, around_z = counts
        self.send(Record(number, number, status, (x, y, z, around_x, around_y, around_z)).encode())

    def send(self, data: bytes) -> None:
        """Send any bytes to the program that has asked."""
        if self._listener is not None:
            with suppress(OSError):
                self._socket.sendto(data, self._listener)

    def _serve(self) -> None:
        while not self._ended.is_set():
            try:
                data, sender = self._socket.recvfrom(64)
            except (TimeoutError, ConnectionError):
                continue
            command = command_of(data)
            if command == START and not self.silent:
                if sender != self._listener:
                    self._listener, self._sequence = sender, 0
                self._asked.set()
            elif command == STOP and sender == self._listener:
                self._listener = None
                self._asked.clear()
                self.stopped.set()


@attrs.frozen(kw_only=True)
class Emulate:
    """Emulate a force-torque sensor whose force along z swings. Ctrl-C ends it."""

    port: int = option(49152, ge=0, le=65535, help="UDP port on the loopback interface; 0 for a free one")
    rate: float = option(100.0, unit="Hz", gt=0, le=7000, help="records per second")
    force: float = option(5.0, unit="N", help="greatest force")

    def __call__(self) -> None:
        """Measure until a signal."""
        ended = threading.Event()
        on_signals(ended.set)
        try:
            sensor = EmulatedNetFt(self.port)
        except OSError as error:
            raise RequestError(f"--port {self.port}: {error}; choose another") from None
        with sensor:
            echo(f"127.0.0.1:{sensor.port}")
            echo("Ctrl-C ends it", err=True)
            while not ended.wait(1 / self.rate):
                force = self.force * math.sin(2 * math.pi * time.monotonic())
                sensor.measure((0, 0, round(1e6 * force), 0, 0, 0))
