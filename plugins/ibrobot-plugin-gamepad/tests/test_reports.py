"""Reports of every make: samples laid out as the drivers' documentation has them, and whatever else may come."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_gamepad.controls import MOUSE_AXES, PAD_AXES, Controls
from ibrobot_gamepad.reports import MODELS, SPACE_MOUSE, Model, model_of
from ibrobot_gamepad.reports.eightbitdo import parse_8bitdo
from ibrobot_gamepad.reports.microsoft import parse_xbox, parse_xbox_one_s
from ibrobot_gamepad.reports.nintendo import OPENING, SwitchPro
from ibrobot_gamepad.reports.sony import parse_dualsense, parse_dualshock4
from ibrobot_gamepad.reports.threedconnexion import SpaceMouse

from .fake_hid import dualsense, mouse_buttons, spacemouse, with_checksum

ALL = (*MODELS, SPACE_MOUSE)
Parse = Callable[[bytes], Controls | None]


def read(parse: Parse, report: bytes) -> Controls:
    state = parse(report)
    assert state is not None
    return state


def moved(state: Controls) -> dict[str, float]:
    return {name: round(value, 2) for name, value in state.axes.items() if abs(value) > 0.01}


def words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}H", *values)


REST = 32768
XBOX = b"\x01" + words(65535, 0, REST, REST) + words(1023, 0) + bytes([3, 0b0100_0001, 0b0000_1000, 0])
"""Series X|S: left stick right and up, left trigger, pad right; A, LB and Menu."""
XBOX_SHORT = b"\x01" + words(REST, REST, 0, 65535) + words(0, 512) + bytes([0, 0b1000_0100, 0b01])
"""First One S: right stick left and down, right trigger half; X, Menu and the left stick."""
DUALSHOCK = bytes([0x01, 255, 127, 128, 0, 0x18, 0b0010_0001, 0b01, 0, 255])
"""Left stick right, right stick up; square, L1, Options, PS; R2."""
EIGHT = bytes([0x01, 6, 127, 255, 127, 127, 255, 0, 0b0001_0001, 0b0000_1000])
"""Left stick down, pad left, right trigger; south, north and start."""
EIGHT_OLD = bytes([0b0100_0000, 0b0000_0010, 15, 0, 127, 127, 127, 0, 0])
"""Left stick left; the left shoulder and the right trigger."""

SAMPLES: dict[str, tuple[Parse, bytes, dict[str, float], set[str]]] = {
    "DualSense, USB": (
        parse_dualsense, dualsense("south", "left_shoulder", "guide", left=(1, 0), triggers=(0, 1), hat=(0, 1)),
        {"left_x": 1.0, "right_trigger": 1.0, "dpad_y": 1.0}, {"south", "left_shoulder", "guide"},
    ),
    "DualSense, Bluetooth": (
        parse_dualsense, with_checksum(b"\x31\x10" + dualsense("misc", "back", right=(0, -1))[1:]),
        {"right_y": -1.0}, {"misc", "back"},
    ),
    "DualSense, Bluetooth before its setup": (
        parse_dualsense, DUALSHOCK, {"left_x": 1.0, "right_y": 1.0, "right_trigger": 1.0},
        {"west", "left_shoulder", "start", "guide"},
    ),
    "DualShock 4, USB": (
        parse_dualshock4, DUALSHOCK.ljust(64, b"\0"), {"left_x": 1.0, "right_y": 1.0, "right_trigger": 1.0},
        {"west", "left_shoulder", "start", "guide"},
    ),
    "DualShock 4, Bluetooth": (
        parse_dualshock4, with_checksum(b"\x11\xc0\x00" + DUALSHOCK[1:]),
        {"left_x": 1.0, "right_y": 1.0, "right_trigger": 1.0}, {"west", "left_shoulder", "start", "guide"},
    ),
    "Xbox Series": (
        parse_xbox, XBOX, {"left_x": 1.0, "left_y": 1.0, "left_trigger": 1.0, "dpad_x": 1.0},
        {"south", "left_shoulder", "start"},
    ),
    "Xbox Series, Share": (parse_xbox, XBOX[:-1] + b"\x01", {}, {"misc"}),
    "Xbox One S, View": (parse_xbox_one_s, XBOX[:-1] + b"\x01", {}, {"back"}),
    "Xbox One S, first firmware": (
        parse_xbox_one_s, XBOX_SHORT, {"right_x": -1.0, "right_y": -1.0, "right_trigger": 0.5},
        {"west", "start", "left_stick"},
    ),
    "8BitDo": (
        parse_8bitdo, EIGHT, {"left_y": -1.0, "dpad_x": -1.0, "right_trigger": 1.0}, {"south", "north", "start"},
    ),
    "8BitDo, first firmware": (
        parse_8bitdo, EIGHT_OLD, {"left_x": -1.0, "right_trigger": 1.0}, {"left_shoulder"},
    ),
    "SpaceMouse": (SpaceMouse(), spacemouse(x=0.5, yaw=-1), {"x": 0.5, "yaw": -1.0}, set()),
    "SpaceMouse, buttons": (SpaceMouse(), mouse_buttons(0, 2), {}, {"left", "button3"}),
}  # fmt: skip


@pytest.mark.parametrize(("parse", "report", "axes", "buttons"), SAMPLES.values(), ids=SAMPLES.keys())
def test_documented_reports(parse: Parse, report: bytes, axes: dict[str, float], buttons: set[str]):
    state = read(parse, report)
    if axes:
        assert moved(state) == axes
    assert buttons <= state.buttons
    if axes:
        assert buttons == state.buttons


def packed(*pairs: tuple[int, int]) -> bytes:
    return b"".join(bytes([a & 255, a >> 8 | (b & 15) << 4, b >> 4]) for a, b in pairs)


CALIBRATION = packed((1400, 1300), (2000, 2100), (1500, 1600), (2050, 2040), (1450, 1350), (1420, 1320))
"""Left: up, rest, down; right: rest, down, up."""


def switch(sticks: bytes, buttons: tuple[int, int, int] = (0, 0, 0), number: int = 0x30) -> bytes:
    return (bytes([number, 0, 0x8E, *buttons]) + sticks + bytes([0])).ljust(64, b"\0")


def answer(data: bytes) -> bytes:
    head = switch(packed((2000, 2100), (2050, 2040)), number=0x21)[:13]
    return (head + bytes([0x90, 0x10, 0x3D, 0x60, 0, 0, 18]) + data).ljust(64, b"\0")


def test_switch_pro_says_nothing_before_its_calibration():
    parse = SwitchPro()
    full = switch(packed((2000, 2100), (2050, 2040)))
    assert parse(full) is None
    for nothing in (bytes(18), b"\xff" * 18):
        assert parse(answer(nothing)) is None, "a flash that was erased"
    assert parse(answer(CALIBRATION)) is not None
    assert moved(read(parse, full)) == {}
    assert [request[10] for request in OPENING] == [0x10, 0x03]


def test_switch_pro_scales_sticks_by_its_calibration():
    parse = SwitchPro()
    parse(answer(CALIBRATION))
    ends = switch(packed((2000 + 1400, 2100 - 1600), (2050 - 1450, 2040 + 1320)), (0b1000_1000, 0b10, 0b0100_0010))
    state = read(parse, ends)
    assert moved(state) == {
        "left_x": 1.0,
        "left_y": -1.0,
        "right_x": -1.0,
        "right_y": 1.0,
        "right_trigger": 1.0,
        "dpad_y": 1.0,
    }
    assert state.buttons == {"east", "start", "left_shoulder"}


def test_spacemouse_puts_its_reports_together():
    parse = SpaceMouse()
    parse(struct.pack("<B3h", 1, 350, 0, -175))
    parse(struct.pack("<B3h", 2, 0, 0, 700))
    state = read(parse, mouse_buttons(1))
    assert moved(state) == {"y": -1.0, "z": 0.5, "yaw": -1.0}
    assert state.buttons == {"right"}


@pytest.mark.parametrize("report", [with_checksum(b"\x31"), with_checksum(b"\x11")])
def test_a_damaged_bluetooth_report_is_left_out(report: bytes):
    for parse in (parse_dualsense, parse_dualshock4):
        for i in (5, 40, 77):
            damaged = bytearray(report)
            damaged[i] ^= 1
            assert parse(bytes(damaged)) is None


@pytest.mark.parametrize("model", ALL, ids=lambda model: model.name)
@given(
    reports=st.lists(
        st.binary(max_size=80)
        | st.integers(0, 255).flatmap(
            lambda number: st.sampled_from([7, 9, 10, 13, 16, 17, 64, 78]).flatmap(
                lambda size: st.binary(min_size=size - 1, max_size=size - 1).map(lambda rest: bytes([number]) + rest)
            )
        ),
        max_size=8,
    )
)
def test_whatever_comes_is_a_state_within_bounds_or_nothing(model: Model, reports: list[bytes]):
    parse = model.start()
    for report in reports:
        state = parse(report)
        if state is not None:
            assert tuple(state.axes) == (PAD_AXES if model.kind == "gamepad" else MOUSE_AXES)
            assert all(math.isfinite(value) and -1 <= value <= 1 for value in state.axes.values())


@given(
    st.sampled_from([-1.0, 0.0, 1.0]),
    st.floats(-1, 1),
    st.floats(0, 1),
    st.sets(st.sampled_from(["south", "east", "west", "north", "start", "guide", "right_stick"])),
)
def test_a_dualsense_report_comes_back_as_it_was_made(x: float, y: float, pulled: float, buttons: set[str]):
    state = read(parse_dualsense, dualsense(*buttons, left=(x, y), triggers=(pulled, 0)))
    assert state.buttons == buttons
    assert state.axes["left_x"] == pytest.approx(x, abs=0.01)
    assert state.axes["left_y"] == pytest.approx(y, abs=0.01)
    assert state.axes["left_trigger"] == pytest.approx(pulled, abs=0.01)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_a_pad_is_known_by_its_vendor_and_product(model: Model):
    for vendor, product in model.ids:
        assert model_of(vendor, product, 0x01, 0x05) is model
        assert model_of(vendor, product, 0xFF00, 0x05) is None, "another interface of the pad"
    assert model_of(model.ids[0][0], 0xFFFF, 0x01, 0x05) is None


def test_a_six_axis_device_is_known_by_its_usage():
    assert model_of(0x256F, 0xC635, 0x01, 0x08) is SPACE_MOUSE
    assert model_of(0x046D, 0xC626, 0x01, 0x08) is SPACE_MOUSE
    assert model_of(0x046D, 0xC21D, 0x01, 0x05) is None
