"""Xbox pads over Bluetooth, by the report descriptors that xpadneo's documentation prints.

Over USB and the wireless dongle they speak XInput or GIP, which no operating system hands to programs as HID: there the
kernel's driver reads them, and SDL the kernel.
"""

from __future__ import annotations

import struct

from ibrobot_gamepad.controls import Controls, pad
from ibrobot_gamepad.reports.fields import bits, hat, word_axis

_HEAD = struct.Struct("<x4H2HBB")
"""Report number, sticks, triggers, hat, first byte of buttons."""
_SHORT = ("south", "east", "west", "north", "left_shoulder", "right_shoulder", "back", "start")
_SHORT_MORE = ("left_stick", "right_stick")
_LONG = ("south", "east", "", "west", "north", "", "left_shoulder", "right_shoulder")
_LONG_MORE = ("", "", "back", "start", "guide", "left_stick", "right_stick")


def parse_xbox(report: bytes) -> Controls | None:
    """Report 0x01: 16 bytes by the first firmware of the Xbox One S, 17 and more by all later ones."""
    if report[:1] != b"\x01" or len(report) not in range(16, 65):
        return None
    *sticks, left, right, direction, first = _HEAD.unpack_from(report)
    if max(left, right) > 1023 or direction > 8:
        return None
    left_x, left_y, right_x, right_y = (word_axis(each) for each in sticks)
    if len(report) == 16:
        buttons = bits(first, _SHORT) + bits(report[15], _SHORT_MORE)
    else:
        # The lowest bit of the last byte is View on an Xbox One S, Share on a Series X|S that has a View of its own.
        buttons = bits(first, _LONG) + bits(report[15], _LONG_MORE) + bits(report[16], ("misc",))
    return pad((left_x, -left_y, right_x, -right_y), (left / 1023, right / 1023), hat(direction - 1), buttons)


def parse_xbox_one_s(report: bytes) -> Controls | None:
    """As `parse_xbox`, for pads without a Share button: its bit is View."""
    controls = parse_xbox(report)
    if controls is None or "misc" not in controls.buttons:
        return controls
    return Controls(controls.axes, controls.buttons - {"misc"} | {"back"})
