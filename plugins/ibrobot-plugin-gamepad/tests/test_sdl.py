"""Pads of SDL's mapping database, as SDL's own virtual joysticks: through SDL, without a device."""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_gamepad.devices import DeviceGone
from ibrobot_gamepad.finder import Finder, open_first
from ibrobot_gamepad.options import GamepadOptions
from ibrobot_gamepad.teleop import JogTeleop
from ibrobot_testing import host_context

from ibrobot_core.api import JointReading, ns

from .fake_hid import FakeHidapi

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import sdl2

LEFT_SHOULDER, LEFT_X = 9, 0


@attrs.define
class Joysticks:
    """Virtual joysticks that a test plugs in."""

    plugged: list[Any] = attrs.field(factory=list)

    def plug(self, name: bytes, *, mapped: bool, axes: int = 6) -> Any:
        description = sdl2.SDL_VirtualJoystickDesc()
        ctypes.memset(ctypes.byref(description), 0, ctypes.sizeof(description))
        description.version, description.name = 1, name
        description.type = sdl2.SDL_JOYSTICK_TYPE_GAMECONTROLLER if mapped else sdl2.SDL_JOYSTICK_TYPE_THROTTLE
        description.naxes, description.nbuttons, description.nhats = axes, 15, 0 if mapped else 1
        description.vendor_id, description.product_id = 0x045E, 0x028E if mapped else 0xFFF0
        index = sdl2.SDL_JoystickAttachVirtualEx(description)
        assert index >= 0, sdl2.SDL_GetError()
        joystick = sdl2.SDL_JoystickOpen(index)
        self.plugged.append(joystick)
        return joystick

    def unplug(self, joystick: Any) -> None:
        number = sdl2.SDL_JoystickInstanceID(joystick)
        indices = range(sdl2.SDL_NumJoysticks())
        sdl2.SDL_JoystickDetachVirtual(next(i for i in indices if sdl2.SDL_JoystickGetDeviceInstanceID(i) == number))
        sdl2.SDL_JoystickClose(joystick)
        self.plugged.remove(joystick)


@pytest.fixture
def finder(hidapi: FakeHidapi) -> Iterator[Finder]:
    with closing(Finder("gamepad")) as finder:
        yield finder


@pytest.fixture
def joysticks(finder: Finder) -> Iterator[Joysticks]:
    made = Joysticks()
    yield made
    for joystick in tuple(made.plugged):
        made.unplug(joystick)


def test_a_pad_of_the_database_has_the_names_of_a_standard_pad(finder: Finder, joysticks: Joysticks):
    pad = joysticks.plug(b"Xbox 360 Controller", mapped=True)
    opened = open_first(finder.find(), "045e:028e")
    assert opened is not None
    found, device = opened
    assert (found.name, found.model, found.via) == ("Xbox 360 Controller", "in SDL's database", "sdl")
    sdl2.SDL_JoystickSetVirtualAxis(pad, 1, -32768)
    sdl2.SDL_JoystickSetVirtualAxis(pad, 5, 32767)
    sdl2.SDL_JoystickSetVirtualButton(pad, LEFT_SHOULDER, 1)
    with closing(device):
        (controls,) = device.poll(0)
        assert controls.buttons == {"left_shoulder"}
        assert controls.axes["left_y"] == 1.0
        assert controls.axes["right_trigger"] == pytest.approx(1.0, abs=1e-3)
        joysticks.unplug(pad)
        with pytest.raises(DeviceGone, match="unplugged"):
            device.poll(0)
    device.close()
    with pytest.raises(DeviceGone, match="closed"):
        device.poll(0)


def test_a_pad_that_nobody_knows_has_numbered_controls(finder: Finder, joysticks: Joysticks):
    stick = joysticks.plug(b"Homemade", mapped=False, axes=3)
    opened = open_first(finder.find(), "045e:fff0")
    assert opened is not None
    found, device = opened
    assert found.model == "axes and buttons by number"
    sdl2.SDL_JoystickSetVirtualAxis(stick, 2, -32768)
    sdl2.SDL_JoystickSetVirtualButton(stick, 7, 1)
    sdl2.SDL_JoystickSetVirtualHat(stick, 0, sdl2.SDL_HAT_RIGHTUP)
    with closing(device):
        (controls,) = device.poll(0)
        assert controls.axes == {"axis0": 0.0, "axis1": 0.0, "axis2": -1.0, "hat0_x": 1.0, "hat0_y": 1.0}
        assert controls.buttons == {"button7"}


def test_a_pad_that_went_before_it_was_opened_is_reported(finder: Finder, joysticks: Joysticks):
    pad = joysticks.plug(b"Xbox 360 Controller", mapped=True)
    (found,) = [each for each in finder.find() if each.id == "045e:028e"]
    joysticks.unplug(pad)
    with pytest.raises(OSError, match="unplugged in the meantime"):
        found.open()


@pytest.mark.parametrize("mapped", [True, False], ids=["in the database", "by number"])
def test_a_pad_read_by_sdl_moves_the_arm_and_holds_when_it_is_unplugged(joysticks: Joysticks, mapped: bool):
    options = GamepadOptions(cartesian=False, via="sdl")
    if not mapped:
        options = attrs.evolve(options, buttons={"deadman": "button9"}, joints={"shoulder_pan": "axis0"})
    pad = joysticks.plug(b"Pad", mapped=mapped)
    position, time_s = np.full(6, 0.3), 5.0
    with closing(_Connected(options)) as run:

        def tick() -> float | None:
            nonlocal time_s
            time_s += 0.01
            positions = run.teleop.read(JointReading(ns(time_s), position, position, position)).positions
            return positions["shoulder_pan"] if positions is not None else None

        assert tick() is None
        sdl2.SDL_JoystickSetVirtualButton(pad, LEFT_SHOULDER, 1)
        assert tick() == 0.3
        sdl2.SDL_JoystickSetVirtualAxis(pad, LEFT_X, 32767)
        assert tick() == pytest.approx(0.308, abs=1e-5)
        joysticks.unplug(pad)
        assert tick() is None
        pad = joysticks.plug(b"Pad", mapped=mapped)
        sdl2.SDL_JoystickSetVirtualButton(pad, LEFT_SHOULDER, 1)
        time_s += 1
        assert [tick() for _ in range(15)] == [None] * 15
        sdl2.SDL_JoystickSetVirtualButton(pad, LEFT_SHOULDER, 0)
        assert tick() is None
        sdl2.SDL_JoystickSetVirtualButton(pad, LEFT_SHOULDER, 1)
        assert tick() == 0.3


class _Connected:
    def __init__(self, options: GamepadOptions) -> None:
        self.teleop = JogTeleop(options, host_context("pad"))
        self.teleop.connect()

    def close(self) -> None:
        self.teleop.disconnect()
