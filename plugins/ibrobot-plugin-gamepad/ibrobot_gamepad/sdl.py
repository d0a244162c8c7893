"""All other pads, by SDL: its mapping database knows their axes and buttons.

SDL reads pads through the kernel's drivers, e.g. Xbox pads over USB and the wireless dongle. It must not read reports
itself: that would reconfigure devices that `ibrobot_gamepad.hid` has open.
"""

from __future__ import annotations

import warnings
from typing import Any, override

from ibrobot_core.api import TeleopError
from ibrobot_gamepad.controls import Controls, pad
from ibrobot_gamepad.devices import Device, DeviceGone, Found

_FULL = 32768
_HINTS = {
    b"SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS": b"1",  # ibrobot has no window
    b"SDL_JOYSTICK_HIDAPI": b"0",
    b"SDL_NO_SIGNAL_HANDLERS": b"1",
    b"SDL_GAMECONTROLLER_USE_BUTTON_LABELS": b"0",  # buttons by position
}
_BUTTONS = {
    "south": "A", "east": "B", "west": "X", "north": "Y", "left_shoulder": "LEFTSHOULDER",
    "right_shoulder": "RIGHTSHOULDER", "left_stick": "LEFTSTICK", "right_stick": "RIGHTSTICK", "back": "BACK",
    "start": "START", "guide": "GUIDE", "touchpad": "TOUCHPAD", "misc": "MISC1",
}  # fmt: skip
_HAT_X, _HAT_Y = {2: 1.0, 8: -1.0}, {1: 1.0, 4: -1.0}
"""Bits of a hat: up, right, down, left."""


def _sdl() -> Any:
    """SDL's functions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the binding warns which library it found
        import sdl2
    return sdl2


def start_sdl() -> None:
    """Let SDL watch joysticks, until `stop_sdl` is called as often as this.

    Raises:
        TeleopError: when it does not start.
    """
    sdl2 = _sdl()
    for hint, value in _HINTS.items():
        sdl2.SDL_SetHint(hint, value)
    if sdl2.SDL_InitSubSystem(sdl2.SDL_INIT_GAMECONTROLLER):
        raise TeleopError(f"SDL does not start: {sdl2.SDL_GetError().decode(errors='replace')}")


def stop_sdl() -> None:
    """Undo a `start_sdl`; close open joysticks first."""
    sdl2 = _sdl()
    sdl2.SDL_QuitSubSystem(sdl2.SDL_INIT_GAMECONTROLLER)


def find_sdl() -> list[Found]:
    """The joysticks that SDL finds after `start_sdl`."""
    sdl2 = _sdl()
    sdl2.SDL_GameControllerUpdate()
    return [_found(sdl2, index) for index in range(max(0, sdl2.SDL_NumJoysticks()))]


def _found(sdl2: Any, index: int) -> Found:
    mapped = bool(sdl2.SDL_IsGameController(index))
    raw_name = sdl2.SDL_GameControllerNameForIndex(index) if mapped else sdl2.SDL_JoystickNameForIndex(index)
    number = sdl2.SDL_JoystickGetDeviceInstanceID(index)
    return Found(
        (raw_name or b"joystick").decode(errors="replace"), sdl2.SDL_JoystickGetDeviceVendor(index),
        sdl2.SDL_JoystickGetDeviceProduct(index), "", "in SDL's database" if mapped else "axes and buttons by number",
        "sdl", lambda: SdlDevice(number), (sdl2.SDL_JoystickPathForIndex(index) or b"").decode(errors="replace"),
    )  # fmt: skip


class SdlDevice(Device):
    """A joystick of SDL. Its controls have the names of a standard pad if the database knows it, otherwise numbers.

    Args:
        number: SDL's number of the connection.

    Raises:
        OSError: when it cannot be opened or is gone.
    """

    def __init__(self, number: int) -> None:
        sdl2 = self._sdl2 = _sdl()
        indices = range(sdl2.SDL_NumJoysticks())
        index = next((i for i in indices if sdl2.SDL_JoystickGetDeviceInstanceID(i) == number), None)
        if index is None:
            raise OSError("unplugged in the meantime")
        self._controller = sdl2.SDL_GameControllerOpen(index) if sdl2.SDL_IsGameController(index) else None
        self._joystick = sdl2.SDL_JoystickOpen(index)
        self._last: Controls | None = None
        if not self._joystick:
            raise OSError(sdl2.SDL_GetError().decode(errors="replace"))

    @override
    def poll(self, now_ns: int) -> list[Controls]:
        if not self._joystick:
            raise DeviceGone("closed")
        self._sdl2.SDL_GameControllerUpdate()
        if not self._sdl2.SDL_JoystickGetAttached(self._joystick):
            raise DeviceGone("unplugged")
        state = self._standard() if self._controller else self._numbered()
        if state == self._last:
            return []
        self._last = state
        return [state]

    @override
    def close(self) -> None:
        if self._controller:
            self._sdl2.SDL_GameControllerClose(self._controller)
        if self._joystick:
            self._sdl2.SDL_JoystickClose(self._joystick)
        self._controller = self._joystick = None

    def _standard(self) -> Controls:
        sdl2, controller = self._sdl2, self._controller

        def axis(name: str) -> float:
            code = getattr(sdl2, f"SDL_CONTROLLER_AXIS_{name}")
            return float(sdl2.SDL_GameControllerGetAxis(controller, code)) / _FULL

        def pressed(name: str) -> int:
            code = getattr(sdl2, f"SDL_CONTROLLER_BUTTON_{name}")
            return int(sdl2.SDL_GameControllerGetButton(controller, code))

        right, up = pressed("DPAD_RIGHT") - pressed("DPAD_LEFT"), pressed("DPAD_UP") - pressed("DPAD_DOWN")
        return pad(
            (axis("LEFTX"), -axis("LEFTY"), axis("RIGHTX"), -axis("RIGHTY")),
            (axis("TRIGGERLEFT"), axis("TRIGGERRIGHT")),
            (right, up),
            ((name, pressed(code)) for name, code in _BUTTONS.items()),
        )

    def _numbered(self) -> Controls:
        sdl2, joystick = self._sdl2, self._joystick
        axes = {
            f"axis{i}": max(-1.0, sdl2.SDL_JoystickGetAxis(joystick, i) / (_FULL - 1))
            for i in range(sdl2.SDL_JoystickNumAxes(joystick))
        }
        for i in range(sdl2.SDL_JoystickNumHats(joystick)):
            hat = sdl2.SDL_JoystickGetHat(joystick, i)
            axes[f"hat{i}_x"] = sum(way for bit, way in _HAT_X.items() if hat & bit)
            axes[f"hat{i}_y"] = sum(way for bit, way in _HAT_Y.items() if hat & bit)
        buttons = (f"button{i}" for i in range(sdl2.SDL_JoystickNumButtons(joystick)))
        return Controls(
            axes, frozenset(name for i, name in enumerate(buttons) if sdl2.SDL_JoystickGetButton(joystick, i))
        )
