"""DualShock 4 and DualSense, as the Linux driver hid-playstation describes their reports."""

from __future__ import annotations

import zlib

from ibrobot_gamepad.controls import Controls, pad
from ibrobot_gamepad.reports.fields import bits, byte_axis, hat

_FACE = ("west", "south", "east", "north")
"""Square, cross, circle, triangle."""
_SHOULDERS = ("left_shoulder", "right_shoulder", "", "", "back", "start", "left_stick", "right_stick")
_EXTRAS = ("guide", "touchpad", "misc")
_INPUT_HEADER = b"\xa1"
"""Byte before an input report over Bluetooth, which the checksum covers."""


def parse_dualshock4(report: bytes) -> Controls | None:
    """Report 0x01 of USB (64 bytes) and of Bluetooth before it is set up (10), or 0x11 of Bluetooth (78)."""
    if report[:1] == b"\x01" and len(report) in (10, 64):
        return _early(report[1:10])
    if report[:1] == b"\x11" and _intact(report):
        return _early(report[3:12])
    return None


def parse_dualsense(report: bytes) -> Controls | None:
    """Report 0x01 of USB (64 bytes) and of Bluetooth before it is set up (10), or 0x31 of Bluetooth (78)."""
    if report[:1] == b"\x01" and len(report) == 64:
        return _dualsense(report[1:11])
    if report[:1] == b"\x01" and len(report) == 10:
        return _early(report[1:10])
    if report[:1] == b"\x31" and _intact(report):
        return _dualsense(report[2:12])
    return None


def _early(part: bytes) -> Controls:
    """Nine bytes: sticks, three of buttons, triggers."""
    return _controls(part[:4], part[7:9], part[4:7])


def _dualsense(part: bytes) -> Controls:
    """Ten bytes: sticks, triggers, a counter, three of buttons."""
    return _controls(part[:4], part[4:6], part[7:10])


def _controls(sticks: bytes, triggers: bytes, buttons: bytes) -> Controls:
    left_x, left_y, right_x, right_y = (byte_axis(each) for each in sticks)
    pressed = bits(buttons[0] >> 4, _FACE) + bits(buttons[1], _SHOULDERS) + bits(buttons[2], _EXTRAS)
    return pad((left_x, -left_y, right_x, -right_y), (each / 255 for each in triggers), hat(buttons[0] & 0x0F), pressed)


def _intact(report: bytes) -> bool:
    """Whether a Bluetooth report of 78 bytes ends with its CRC-32."""
    if len(report) != 78:
        return False
    return zlib.crc32(_INPUT_HEADER + report[:-4]) == int.from_bytes(report[-4:], "little")
