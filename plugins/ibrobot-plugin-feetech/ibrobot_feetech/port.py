"""A serial port for requests and replies: exclusive, raw, with blocking reads that have a deadline."""

from __future__ import annotations

import errno
import fcntl
import os
import select
import shlex
import termios
import time
from contextlib import suppress

import serial

from ibrobot_core.api import HardwareError
from ibrobot_feetech.errors import Place, PortError, PortForbidden, PortHeld
from ibrobot_feetech.usb import BY_SERIAL, find_port

_GONE = (errno.EIO, errno.ENODEV, errno.ENXIO, errno.EBADF)
_VMIN = 6
"""Index of the control characters among a terminal's attributes."""
_NOTHING = bytes(4)
_WRITE_S = 0.05
"""Time beyond that on the wire after which a request that the port does not take fails [s]."""
_BITS_PER_BYTE = 10
_MOST_AWAITED = 255
"""Maximum number of bytes for which the kernel can delay waking a reader."""


def is_device(path: str) -> bool:
    """Whether a port is that of an adapter; one outside /dev is that of an emulator."""
    return path.startswith(("/dev/", BY_SERIAL))


def no_such_port(path: str) -> str:
    """What to say of a port that does not exist."""
    known = "there is no such port"
    return known if is_device(path) else f"{known}; for an emulated arm run {emulate(path)}, its calibration as NAME"


def emulate(path: str, calibration: str = "NAME", physics: str = "") -> str:
    """The command that emulates an arm at a port, for messages.

    Args:
        path: the port.
        calibration: name of the arm's calibration.
        physics: the robot YAML whose simulation moves the joints; empty: the servos alone do.
    """
    moved = f"--physics {shlex.quote(physics)} " if physics else ""
    command = f"ibrobot feetech emulate {moved}--link {shlex.quote(path)} --calibration {shlex.quote(calibration)}"
    return f"`{command}` in another terminal"


class SerialPort:
    """One open serial port.

    A reader sleeps until the complete reply has arrived (with the line discipline's VMIN, which `poll` honours). This
    takes one wake-up per exchange instead of one per packet.

    Args:
        path: e.g. `/dev/ttyACM0`, or `serial:` with the USB serial number of its adapter.
        baud_rate: [baud].
    """

    def __init__(self, path: str, baud_rate: int) -> None:
        self.path = path
        self.baud_rate = baud_rate
        self._serial: serial.Serial | None = None
        self._fd = -1
        self._wake_at = 0
        self._is_stuck = False
        self._waiting = bytearray(4)

    @property
    def is_open(self) -> bool:
        """Whether the port is open; it may nevertheless be unplugged."""
        return self._serial is not None

    def open(self) -> None:
        """Open the port for this process alone.

        Raises:
            PortError: if it does not exist, is not permitted, or is held by another program.
        """
        if self._serial is not None:
            return
        try:
            path = find_port(self.path)
        except HardwareError as error:
            raise PortError(Place(self.path), str(error)) from None
        try:
            self._serial = serial.Serial(path, self.baud_rate, timeout=0, write_timeout=None, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise _why_closed(Place(self.path), error) from None
        # Drivers without this flag are already fast, or cannot be made faster.
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
            if self._is_stuck:  # closing would wait until the unsent bytes are sent
                with suppress(OSError, termios.error):
                    termios.tcflush(port.fileno(), termios.TCOFLUSH)
            with suppress(OSError, termios.error):
                port.close()

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change the baud rate [baud].

        Raises:
            PortError: if the port does not support the rate.
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
            PortError: if the port is gone or closed, or does not take the request in time.
        """
        try:
            self._write_rest(request, self._write_some(request))
        except OSError as error:
            raise self._gone(error) from None

    def read(self, size: int, deadline: float) -> bytes:
        """Read all bytes until at least `size` have arrived or `time.monotonic()` reaches `deadline` [s].

        Raises:
            PortError: if the port is gone or closed.
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
        """Send `request` and return the bytes received when `size` have arrived or at the timeout; optimised for ticks.

        Raises:
            PortError: if the port is gone or closed, or does not take the request in time.
        """
        if size > _MOST_AWAITED:
            self.write(request)
            return self.read(size, time.monotonic() + timeout_ms / 1e3)
        if size != self._wake_at:
            self._wake_when(size)
        try:
            if (sent := self._write_some(request)) < len(request):
                self._write_rest(request, sent)
            if self._poll.poll(timeout_ms):
                if received := os.read(self._fd, size):
                    return received
                raise PortError(Place(self.path), "the port is closed at its other end")
            return self._pending()
        except OSError as error:
            raise self._gone(error) from None

    def _write_some(self, request: bytes) -> int:
        try:
            sent = os.write(self._fd, request)
        except BlockingIOError:
            return 0
        self._is_stuck &= sent < len(request)
        return sent

    def _write_rest(self, request: bytes, sent: int) -> None:
        """Send `request` from byte `sent` on, before a deadline; discard all unsent bytes if it passes."""
        patience_s = 0.0 if self._is_stuck else _WRITE_S + len(request) * _BITS_PER_BYTE / self.baud_rate
        deadline = time.monotonic() + patience_s
        while sent < len(request):
            if not select.select((), (self._fd,), (), max(0.0, deadline - time.monotonic()))[1]:
                self._is_stuck = True  # later requests do not wait for it again
                # Commands that wait in the kernel would move the arm when the port goes on.
                termios.tcflush(self._fd, termios.TCOFLUSH)
                raise PortError(
                    Place(self.path), f"the port takes no bytes: a request was not sent within {_WRITE_S:g} s"
                )
            sent += self._write_some(request[sent:])

    def discard(self) -> int:
        """Discard received bytes; returns their number.

        Raises:
            PortError: if the port is gone or closed.
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
        return PortError(place, no_such_port(place.port))
    if number in (errno.EACCES, errno.EPERM):
        return PortForbidden(place, "no permission")
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "exclusively lock" in str(error):
        return PortHeld(place, "another program holds the port")
    return PortError(place, f"cannot be opened: {getattr(error, 'strerror', None) or error}")
