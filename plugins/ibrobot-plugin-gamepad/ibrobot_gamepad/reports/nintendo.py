"""Switch Pro, as the Linux driver hid-nintendo and the notes that it cites describe its reports."""

from __future__ import annotations

from ibrobot_gamepad.controls import Controls, pad
from ibrobot_gamepad.reports.fields import bits

_RIGHT = ("west", "north", "south", "east", "", "", "right_shoulder", "right_trigger")
"""Y, X, B, A: by their place."""
_SHARED = ("back", "start", "right_stick", "left_stick", "guide", "misc")
_LEFT = ("down", "up", "right", "left", "", "", "left_shoulder", "left_trigger")
_FULL, _ANSWER = 0x30, 0x21
_HEAD = 12
"""Bytes of the state that begins both reports."""
_RUMBLE_OFF = bytes.fromhex("00 01 40 40 00 01 40 40")
_READ_FLASH, _SET_MODE = 0x10, 0x03
_CALIBRATION = 0x603D
"""Address of the factory calibration of both sticks."""
_CALIBRATION_BYTES = 18
_MOST, _LEAST_SPAN = 0xFFF, 0x100
"""A calibration with a smaller range is invalid."""


def _request(number: int, command: int, arguments: bytes) -> bytes:
    return bytes([0x01, number]) + _RUMBLE_OFF + bytes([command]) + arguments


OPENING = (
    _request(0, _READ_FLASH, _CALIBRATION.to_bytes(4, "little") + bytes([_CALIBRATION_BYTES])),
    _request(1, _SET_MODE, bytes([_FULL])),
)
"""Requests sent on opening: for the calibration, and for full reports."""


def pairs(packed: bytes) -> tuple[tuple[int, int], ...]:
    """Numbers of 12 bits, two in three bytes."""
    return tuple(
        (packed[i] | (packed[i + 1] & 0x0F) << 8, packed[i + 1] >> 4 | packed[i + 2] << 4)
        for i in range(0, len(packed), 3)
    )


class SwitchPro:
    """Reads reports 0x30 and 0x21. It knows no stick's rest before the pad has sent its calibration."""

    def __init__(self) -> None:
        self._sticks: tuple[_Stick, _Stick] | None = None

    def __call__(self, report: bytes) -> Controls | None:
        """The state, or None for a report without one."""
        if len(report) < _HEAD or report[0] not in (_FULL, _ANSWER):
            return None
        if report[0] == _ANSWER:
            self._calibrate(report)
        if self._sticks is None:
            return None
        left = dict(bits(report[5], _LEFT))
        right = dict(bits(report[3], _RIGHT))
        triggers = float(left.pop("left_trigger")), float(right.pop("right_trigger"))
        way = left.pop("right") - left.pop("left"), left.pop("up") - left.pop("down")
        sticks = [each.place(at) for each, at in zip(self._sticks, pairs(report[6:12]), strict=True)]
        return pad((*sticks[0], *sticks[1]), triggers, way, [*left.items(), *right.items(), *bits(report[4], _SHARED)])

    def _calibrate(self, report: bytes) -> None:
        """Take the calibration from the answer to the request for it."""
        begin = bytes([0x90, _READ_FLASH]) + _CALIBRATION.to_bytes(4, "little") + bytes([_CALIBRATION_BYTES])
        data = report[20 : 20 + _CALIBRATION_BYTES]
        if report[13:20] != begin or len(data) < _CALIBRATION_BYTES:
            return
        # Order of the left stick: range up, rest, range down; of the right stick: rest, range down, range up.
        up, rest, down, right_rest, right_down, right_up = pairs(data)
        sticks = _Stick(rest, down, up), _Stick(right_rest, right_down, right_up)
        if all(stick.is_plausible() for stick in sticks):
            self._sticks = sticks


class _Stick:
    def __init__(self, rest: tuple[int, int], down: tuple[int, int], up: tuple[int, int]) -> None:
        self._axes = tuple(zip(rest, down, up, strict=True))

    def is_plausible(self) -> bool:
        """Whether the stick moves to both sides, within its 12 bits."""
        return all(
            min(down, up) >= _LEAST_SPAN and rest - down >= 0 and rest + up <= _MOST for rest, down, up in self._axes
        )

    def place(self, at: tuple[int, int]) -> list[float]:
        """Right and up, -1 to 1 and somewhat beyond."""
        return [
            (value - rest) / (up if value > rest else down)
            for value, (rest, down, up) in zip(at, self._axes, strict=True)
        ]
