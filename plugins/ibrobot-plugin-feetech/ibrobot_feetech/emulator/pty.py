"""Serves emulated servos on a pseudo-terminal, in a thread."""

from __future__ import annotations

import fcntl
import heapq
import os
import select
import struct
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from ibrobot_core.api import Clock, seconds
from ibrobot_feetech.emulator.faults import Faults
from ibrobot_feetech.emulator.servo import EmulatedServo
from ibrobot_feetech.emulator.wire import Wire

_SPEED = 5
"""Index of the output speed in a terminal's attributes."""
_UNASKED = 50
"""A rate that no host uses, to detect whether a host has set one [baud]."""
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("4I20B2I")
"""A terminal's attributes on Linux, the speeds last: in baud, where `termios` has codes and none for 250,000."""


class Emulator:
    """A bus of emulated servos behind a pseudo-terminal; a context manager.

    Servos advance to the clock's present time whenever a byte arrives, so with a stepped clock everything is
    deterministic. `lock` is held while a request is processed; hold it to change several values atomically.

    Args:
        servos: number of servos, with ids from 1; or id -> servo.
        baud_rate: initial rate of the servos [baud].
        throttle: whether to delay bytes by their time on a real wire.
        seed: seed of `faults`.
        clock: clock of the joints' motion; None for the machine's.
        link: path of a symbolic link to the pseudo-terminal, which stays valid after unplugging.
    """

    def __init__(
        self, servos: int | Mapping[int, EmulatedServo] = 6, *, baud_rate: int = 1_000_000, throttle: bool = False,
        seed: int = 0, clock: Clock | None = None, link: Path | str | None = None,
    ) -> None:  # fmt: skip
        made = {i: EmulatedServo(i) for i in range(1, servos + 1)} if isinstance(servos, int) else dict(servos)
        self.servos: dict[int, EmulatedServo] = made
        self.faults = Faults()
        self.lock = threading.RLock()
        self.on_request: Callable[[], None] = lambda: None
        """Called after every request, with the lock held."""
        self._default_rate = baud_rate
        self._wire = Wire(self.servos, self.faults, throttle=throttle, seed=seed)
        self._clock = clock
        self.link = Path(link) if link is not None else None
        self._master = self._slave = -1
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None
        self.port = ""
        """The path of the pseudo-terminal."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    def start(self) -> None:
        """Start serving."""
        self._stop_reader, self._stop_writer = os.pipe()
        self.settle()
        self._plug()

    def stop(self) -> None:
        """Stop, and raise any error of the serving thread."""
        self.unplug()
        os.close(self._stop_reader)
        os.close(self._stop_writer)
        if self._error is not None:
            raise self._error

    def unplug(self) -> None:
        """Unplug the cable: the port disappears for the program that has it open."""
        if self._thread is None:
            return
        os.write(self._stop_writer, b".")
        self._thread.join()
        os.read(self._stop_reader, 1)
        self._thread = None
        if self.link is not None:
            self.link.unlink(missing_ok=True)
        for descriptor in (self._slave, self._master):
            os.close(descriptor)

    def replug(self) -> None:
        """Plug the cable in again: the port has the same link, or a new path in `port`."""
        if self._thread is None:
            self._plug()

    def settle(self) -> None:
        """Advance the joints to the clock's present time without a request."""
        with self.lock:
            self._wire.advance(self._now_s())

    def _plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[_SPEED - 1] = attributes[_SPEED] = termios.B50
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        if self.link is not None:
            if self.link.is_symlink():  # left by an emulator that was killed; never remove anything else
                self.link.unlink()
            self.link.symlink_to(self.port)
        self._thread = threading.Thread(target=self._serve, name=f"emulator {self.port}", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        try:
            self._loop()
        except BaseException as error:  # noqa: BLE001 - re-raised when the emulator is stopped
            self._error = error

    def _loop(self) -> None:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        poll.register(self._stop_reader, select.POLLIN)
        pending: list[tuple[float, int, bytes]] = []
        count = 0
        while True:
            for descriptor, _ in poll.poll(self._wait_ms(pending)):
                if descriptor == self._stop_reader:
                    return
                with suppress(BlockingIOError):
                    arrived = time.monotonic()
                    for after_s, reply in self._carry_out(os.read(self._master, 4096)):
                        heapq.heappush(pending, (arrived + after_s, count, reply))
                        count += 1
            out = b""
            while pending and pending[0][0] <= time.monotonic():
                out += heapq.heappop(pending)[2]
            if out:
                with suppress(BlockingIOError):  # without a reader, bytes are lost, as on a wire
                    os.write(self._master, out)

    def _wait_ms(self, pending: list[tuple[float, int, bytes]]) -> float | None:
        """How long to sleep; 0 in the last millisecond before a reply is due, because `poll` is not precise enough."""
        if not pending:
            return None
        wait_s = pending[0][0] - time.monotonic()
        if wait_s > 0.001:
            return (wait_s - 0.001) * 1e3
        if wait_s > 0:
            time.sleep(wait_s)
        return 0

    def _carry_out(self, received: bytes) -> list[tuple[float, bytes]]:
        with self.lock:
            self._wire.advance(self._now_s())
            replies = self._wire.receive(received, self._host_rate())
            self.on_request()
        return replies

    def _now_s(self) -> float:
        return time.monotonic() if self._clock is None else seconds(self._clock.now_ns())

    def _host_rate(self) -> int:
        """The rate that the host has set; the servos' rate until then."""
        rate = _baud_rate(self._slave)
        return self._default_rate if rate == _UNASKED else rate


def _baud_rate(terminal: int) -> int:
    """A terminal's output speed [baud]."""
    if sys.platform == "linux":
        return int(_TERMIOS2.unpack(fcntl.ioctl(terminal, _TCGETS2, bytes(_TERMIOS2.size)))[-1])
    return int(termios.tcgetattr(terminal)[_SPEED])  # on other systems the codes are the rates
