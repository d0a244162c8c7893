"""Lists V4L2 devices and the formats that they offer, with the kernel's ioctls.

Constants and structures are those of linux/videodev2.h.
"""

from __future__ import annotations

import errno
import fcntl
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import attrs

from ibrobot_camera.device import BY_ID, BY_PATH

_QUERYCAP, _ENUM_FMT, _ENUM_FRAMESIZES, _ENUM_FRAMEINTERVALS = 0x80685600, 0xC0405602, 0xC02C564A, 0xC034564B
_CAPTURE = 1
"""V4L2_BUF_TYPE_VIDEO_CAPTURE, and V4L2_CAP_VIDEO_CAPTURE."""
_DISCRETE = 1
COLUMNS = ("format", "size", "rates [Hz]")
"""Headings of the columns of `Mode.row`."""


@attrs.frozen
class Mode:
    """An image format and size, and the available rates [Hz]."""

    fourcc: str
    width: int
    height: int
    rates_hz: tuple[float, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.width, self.height

    @property
    def row(self) -> tuple[str, str, str]:
        """The columns as texts."""
        return self.fourcc, f"{self.width}x{self.height}", ", ".join(f"{rate:g}" for rate in self.rates_hz)


@attrs.frozen
class Camera:
    """A V4L2 capture device."""

    path: str
    name: str
    stable_id: str
    """Its name under /dev/v4l/by-id; empty if it has none."""
    modes: tuple[Mode, ...]
    problem: str = ""
    """Why its modes could not be read."""
    usb_path: str = ""
    """The name of its USB port under /dev/v4l/by-path, which tells equal cameras apart; empty if it has none."""

    @property
    def lasting_name(self) -> str:
        """Its name for a robot YAML, which stays after a reboot; empty if it has none."""
        return self.stable_id or self.usb_path


def cameras() -> list[Camera]:
    """The capture devices of this machine."""
    ids, paths = (
        {str(entry.resolve()): entry.name for entry in sorted(folder.iterdir())} if folder.is_dir() else {}
        for folder in (BY_ID, BY_PATH)
    )
    connected = []
    for path in sorted(Path("/dev").glob("video*"), key=lambda p: (len(p.name), p.name)):
        try:
            with _opened(path) as device:
                capability = fcntl.ioctl(device, _QUERYCAP, bytes(104))
                if not struct.unpack_from("<I", capability, 88)[0] & _CAPTURE:
                    continue
                card = capability[16:48].split(b"\0")[0].decode(errors="replace")
                camera = Camera(str(path), card, ids.get(str(path), ""), tuple(_modes(device)))
        except OSError as error:
            camera = Camera(str(path), "", ids.get(str(path), ""), (), error.strerror or str(error))
        connected.append(attrs.evolve(camera, usb_path=paths.get(str(path), "")))
    return connected


def modes(path: str) -> tuple[Mode, ...]:
    """The modes that a device offers; empty if it does not report them."""
    try:
        with _opened(Path(path)) as device:
            return tuple(_modes(device))
    except OSError:
        return ()


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    device = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        yield device
    finally:
        os.close(device)


def _modes(device: int) -> Iterator[Mode]:
    for pixel_format in _formats(device):
        fourcc = struct.pack("<I", pixel_format).decode(errors="replace")
        for width, height in _sizes(device, pixel_format):
            yield Mode(fourcc, width, height, tuple(_rates(device, pixel_format, width, height)))


def _formats(device: int) -> Iterator[int]:
    for answer in _enumerate(device, _ENUM_FMT, lambda i: struct.pack("<II56x", i, _CAPTURE)):
        yield struct.unpack_from("<I", answer, 44)[0]


def _sizes(device: int, pixel_format: int) -> Iterator[tuple[int, int]]:
    for answer in _enumerate(device, _ENUM_FRAMESIZES, lambda i: struct.pack("<II36x", i, pixel_format)):
        kind, *numbers = struct.unpack_from("<7I", answer, 8)
        if kind != _DISCRETE:  # minimum and maximum of a range
            yield numbers[0], numbers[3]
            yield numbers[1], numbers[4]
            return
        yield numbers[0], numbers[1]


def _rates(device: int, pixel_format: int, width: int, height: int) -> Iterator[float]:
    for answer in _enumerate(
        device, _ENUM_FRAMEINTERVALS, lambda i: struct.pack("<4I36x", i, pixel_format, width, height)
    ):
        kind, numerator, denominator = struct.unpack_from("<3I", answer, 16)
        if numerator:
            yield denominator / numerator
        if kind != _DISCRETE:
            return


def _enumerate(device: int, request: int, ask: Callable[[int], bytes]) -> Iterator[bytes]:
    for index in range(256):
        try:
            yield fcntl.ioctl(device, request, ask(index))
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return
            raise
