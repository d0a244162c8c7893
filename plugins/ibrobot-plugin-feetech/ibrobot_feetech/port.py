"""A serial port for request and reply: exclusive, raw, with blocking reads that end at a deadline."""

from __future__ import annotations

import errno
import fcntl
import os
import select
import termios
import time
from contextlib import suppress

import serial

from ibrobot_feetech.errors import Place, PortError, PortForbidden, PortHeld

_GONE = (errno.EIO, errno.ENODEV, errno.ENXIO, errno.EBADF)
_VMIN = 6
"""Index of the control characters among a terminal's attributes."""
_NOTHING = bytes(4)
_MOST_AWAITED = 255
"""Greatest number of bytes that a reader can be woken by."""


class SerialPort:
    """One open serial port.

    A reader sleeps until as many bytes are there as its reply has (the line discipline's VMIN, which `poll` honours):
    one wake-up an exchange instead of one a packet.

    Args:
        path: e.g. `/dev/ttyACM0`.
        baud_rate: [baud].
    """

    def __init__(self, path: str, baud_rate: int) -> None:
        self.path = path
        self.baud_rate = baud_rate
        self._serial: serial.Serial | None = None
        self._fd = -1
        self._wake_at = 0
        self._waiting = bytearray(4)

    @property
    def is_open(self) -> bool:
        """Whether the port is open; it may be unplugged all the same."""
        return self._serial is not None

    def open(self) -> None:
        """Open the port for this process alone.

        Raises:
            PortError: when it is not there, not permitted, or held by another program.
        """
        if self._serial is not None:
            return
        try:
            self._serial = serial.Serial(self.path, self.baud_rate, timeout=0, write_timeout=None, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise _why_closed(Place(self.path), error) from None
        # Drivers without such a flag are fast already, or cannot be made so.
        with suppress(OSError, ValueError, NotImplementedError, AttributeError):
            self._serial.set_low_latency_mode(True)
        self._fd = self._serial.fileno()
        self._poll = select.poll()
        self._poll.register(self._fd, select.POLLIN)
        self._wake_at = 0

    def close(self) -> None:
        """Close the port. Safe to call twice."""
        port, self._serial, self._fd = self._serial, None, -1
        if port is not None:
            with suppress(OSError, termios.error):
                port.close()

    def set_baud_rate(self, baud_rate: int) -> None:
        """Go on at another rate [baud].

        Raises:
            PortError: for a rate that the port cannot have.
        """
        self.baud_rate = baud_rate
        if self._serial is not None:
            try:
                self._serial.baudrate = baud_rate
            except (OSError, ValueError, termios.error) as error:
                raise PortError(Place(self.path), f"cannot be set to {baud_rate} baud: {error}") from None
            self._wake_at = 0

    def write(self, request: bytes) -> None:
        """Send all of `request`.

        Raises:
            PortError: when the port is gone or closed.
        """
        try:
            sent = os.write(self._fd, request)
            while sent < len(request):
                select.select((), (self._fd,), ())
                sent += os.write(self._fd, request[sent:])
        except OSError as error:
            raise self._gone(error) from None

    def read(self, size: int, deadline: float) -> bytes:
        """What comes until `size` bytes are there or `time.monotonic()` reaches `deadline` [s]: all of it.

        Raises:
            PortError: when the port is gone or closed.
        """
        received = b""
        while len(received) < size:
            self._wake_when(min(size - len(received), _MOST_AWAITED))
            timeout_ms = max(0.0, deadline - time.monotonic()) * 1e3
            try:
                ready = self._poll.poll(timeout_ms)
                received += os.read(self._fd, 4096) if ready else self._pending()
            except OSError as error:
                raise self._gone(error) from None
            if not ready:
                break
            if not received:
                raise PortError(Place(self.path), "the port is closed at its other end")
        return received

    def exchange(self, request: bytes, size: int, timeout_ms: int) -> bytes:
        """Send `request` and give back what came when `size` bytes are there, or in time: the fast way of a tick.

        Raises:
            PortError: when the port is gone or closed.
        """
        if size > _MOST_AWAITED:
            self.write(request)
            return self.read(size, time.monotonic() + timeout_ms / 1e3)
        if size != self._wake_at:
            self._wake_when(size)
        try:
            if os.write(self._fd, request) < len(request):
                raise OSError(errno.EIO, "the port does not take a request of a few bytes")
            if self._poll.poll(timeout_ms):
                if received := os.read(self._fd, size):
                    return received
                raise PortError(Place(self.path), "the port is closed at its other end")
            return self._pending()
        except OSError as error:
            raise self._gone(error) from None

    def discard(self) -> int:
        """Throw away what has come unasked; returns how many bytes it was.

        Raises:
            PortError: when the port is gone or closed.
        """
        try:
            fcntl.ioctl(self._fd, termios.FIONREAD, self._waiting)
            return len(self._pending()) if self._waiting != _NOTHING else 0
        except (OSError, ValueError) as error:
            raise self._gone(error) from None

    def _pending(self) -> bytes:
        try:
            return os.read(self._fd, 4096)
        except BlockingIOError:
            return b""

    def _wake_when(self, size: int) -> None:
        if size != self._wake_at:
            try:
                attributes = termios.tcgetattr(self._fd)
                attributes[_VMIN][termios.VMIN], attributes[_VMIN][termios.VTIME] = size, 0
                termios.tcsetattr(self._fd, termios.TCSANOW, attributes)
            except termios.error as error:
                raise self._gone(OSError(*error.args)) from None
            self._wake_at = size

    def _gone(self, error: Exception) -> PortError:
        if self._serial is None:
            return PortError(Place(self.path), "the port is not open")
        if getattr(error, "errno", None) in _GONE:
            return PortError(Place(self.path), "the port is gone")
        return PortError(Place(self.path), getattr(error, "strerror", None) or str(error))


def _why_closed(place: Place, error: Exception) -> PortError:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        return PortError(place, "there is no such port")
    if number in (errno.EACCES, errno.EPERM):
        return PortForbidden(place, "no permission")
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "exclusively lock" in str(error):
        return PortHeld(place, "another program holds the port")
    return PortError(place, f"cannot be opened: {getattr(error, 'strerror', None) or error}")
