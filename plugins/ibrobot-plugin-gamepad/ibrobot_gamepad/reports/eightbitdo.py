"""8BitDo pads in their D mode, as SDL reads them; in other modes they are an Xbox, Switch Pro or PlayStation pad."""

from __future__ import annotations

from ibrobot_gamepad.controls import Controls, pad
from ibrobot_gamepad.reports.fields import bits, byte_axis, hat

_FIRST = ("south", "east", "", "west", "north", "", "left_shoulder", "right_shoulder")
_SECOND = ("", "", "back", "start", "guide", "left_stick", "right_stick")
_OLD_SECOND = ("left_trigger", "right_trigger", *_SECOND[2:])
_NUMBERS = (0x01, 0x03, 0x04)
"""Ids of reports over Bluetooth, and over USB by old and by new firmware."""


def parse_8bitdo(report: bytes) -> Controls | None:
    """Reports 0x01, 0x03 and 0x04 (10 bytes and more), or the 9 bytes without a number that old firmware sends."""
    if len(report) == 9:
        second = dict(bits(report[1], _OLD_SECOND))
        triggers = float(second.pop("left_trigger")), float(second.pop("right_trigger"))
        return _controls(report[3:7], triggers, report[2], bits(report[0], _FIRST) + list(second.items()))
    if len(report) not in range(10, 65) or report[0] not in _NUMBERS:
        return None
    buttons = bits(report[8], _FIRST) + bits(report[9], _SECOND)
    return _controls(report[2:6], (report[7] / 255, report[6] / 255), report[1] & 0x0F, buttons)


def _controls(sticks: bytes, triggers: tuple[float, float], way: int, buttons: list[tuple[str, int]]) -> Controls:
    left_x, left_y, right_x, right_y = (byte_axis(each) for each in sticks)
    return pad((left_x, -left_y, right_x, -right_y), triggers, hat(way), buttons)
