"""Fakes at the boundary of hidapi: devices that are plugged in, send reports and are unplugged, and what sends them."""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Iterable
from types import ModuleType
from typing import Any

import attrs


@attrs.define
class Plugged:
    """A device on the bus: what hidapi says of it, and the reports that wait to be read."""

    vendor: int
    product: int
    usage: int = 0x05
    name: str = "Pad"
    serial: str = ""
    path: bytes = b"/dev/hidraw0"
    permitted: bool = True
    present: bool = True
    opened: int = 0
    written: list[bytes] = attrs.field(factory=list)
    _waiting: deque[bytes] = attrs.field(factory=deque)

    def send(self, *reports: bytes) -> None:
        self._waiting.extend(reports)

    def take(self) -> bytes | None:
        return self._waiting.popleft() if self._waiting else None

    def drop(self) -> None:
        self._waiting.clear()


class FakeHidapi(ModuleType):
    """The module `hidraw`."""

    def __init__(self) -> None:
        super().__init__("hidraw")
        self.bus: list[Plugged] = []

    def plug(self, device: Plugged) -> Plugged:
        device.present = True
        if device not in self.bus:
            self.bus.append(device)
        return device

    def unplug(self, device: Plugged) -> None:
        device.present = False
        device.drop()
        self.bus.remove(device)

    def enumerate(self) -> list[dict[str, Any]]:
        return [
            {
                "path": each.path,
                "vendor_id": each.vendor,
                "product_id": each.product,
                "serial_number": each.serial,
                "product_string": each.name,
                "usage_page": 0x01,
                "usage": each.usage,
            }
            for each in self.bus
        ]

    def device(self) -> _Opened:
        return _Opened(self.bus)


class _Opened:
    def __init__(self, bus: list[Plugged]) -> None:
        self._bus = bus
        self._device: Plugged | None = None

    def open_path(self, path: bytes) -> None:
        device = next((each for each in self._bus if each.path == path), None)
        if device is None or not device.permitted:
            raise OSError("open failed")
        device.opened += 1
        self._device = device

    def set_nonblocking(self, on: int) -> None:
        assert on

    def read(self, longest: int) -> list[int]:
        return list(self._alive().take() or b"")[:longest]

    def write(self, report: bytes) -> int:
        self._alive().written.append(report)
        return len(report)

    def close(self) -> None:
        if self._device is not None:
            self._device.opened -= 1
        self._device = None

    def _alive(self) -> Plugged:
        if self._device is None:
            raise ValueError("not open")
        if not self._device.present:
            raise OSError("read error")
        return self._device


HAT_REST = 8
_HAT = {(0, 1): 0, (1, 1): 1, (1, 0): 2, (1, -1): 3, (0, -1): 4, (-1, -1): 5, (-1, 0): 6, (-1, 1): 7, (0, 0): HAT_REST}
_FACE = {"west": 0x10, "south": 0x20, "east": 0x40, "north": 0x80}
_SHOULDERS = {
    "left_shoulder": 0x01,
    "right_shoulder": 0x02,
    "left_trigger": 0x04,
    "right_trigger": 0x08,
    "back": 0x10,
    "start": 0x20,
    "left_stick": 0x40,
    "right_stick": 0x80,
}
_EXTRAS = {"guide": 0x01, "touchpad": 0x02, "misc": 0x04}


def stick_byte(value: float) -> int:
    """A deflection of -1 to 1 as PlayStation pads send it."""
    return round(127.5 + 127.5 * value) if value else 128


def _sony(buttons: Iterable[str], hat: tuple[int, int]) -> list[int]:
    pressed = set(buttons)
    first = _HAT[hat] | sum(bit for name, bit in _FACE.items() if name in pressed)
    return [
        first,
        sum(bit for name, bit in _SHOULDERS.items() if name in pressed),
        sum(bit for name, bit in _EXTRAS.items() if name in pressed),
    ]


def dualsense(
    *buttons: str,
    left: tuple[float, float] = (0, 0),
    right: tuple[float, float] = (0, 0),
    triggers: tuple[float, float] = (0, 0),
    hat: tuple[int, int] = (0, 0),
) -> bytes:
    """A DualSense's USB report 0x01."""
    sticks = [stick_byte(left[0]), stick_byte(-left[1]), stick_byte(right[0]), stick_byte(-right[1])]
    part = [*sticks, *(round(255 * each) for each in triggers), 7, *_sony(buttons, hat)]
    return bytes([0x01, *part]).ljust(64, b"\0")


def with_checksum(report: bytes) -> bytes:
    """A Bluetooth report of 78 bytes with its checksum."""
    body = report.ljust(74, b"\0")[:74]
    return body + zlib.crc32(b"\xa1" + body).to_bytes(4, "little")


def spacemouse(
    *,
    x: float = 0,
    y: float = 0,
    z: float = 0,
    roll: float = 0,
    pitch: float = 0,
    yaw: float = 0,
) -> bytes:
    """A report 1 with all six axes: forward, left, up, and turns about them."""
    counts = (-y, -x, -z, -pitch, -roll, -yaw)
    return struct.pack("<B6h", 1, *(round(350 * each) for each in counts))


def mouse_buttons(*pressed: int) -> bytes:
    """A SpaceMouse's report 3; its buttons count from 0."""
    return struct.pack("<BH", 3, sum(1 << each for each in pressed))


DUALSENSE = (0x054C, 0x0CE6)
SPACEMOUSE = (0x256F, 0xC635)
