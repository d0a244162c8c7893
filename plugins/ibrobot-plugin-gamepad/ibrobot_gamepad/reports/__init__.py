"""The HID reports with a public layout, and the devices that send them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import attrs

from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.reports.eightbitdo import parse_8bitdo
from ibrobot_gamepad.reports.microsoft import parse_xbox, parse_xbox_one_s
from ibrobot_gamepad.reports.nintendo import OPENING, SwitchPro
from ibrobot_gamepad.reports.sony import parse_dualsense, parse_dualshock4
from ibrobot_gamepad.reports.threedconnexion import SpaceMouse

Parse = Callable[[bytes], Controls | None]
"""A report as read, its number first -> the state, or None for a report without one or that is damaged."""
Kind = Literal["gamepad", "spacemouse"]
KINDS: tuple[Kind, ...] = get_args(Kind)

_GENERIC_DESKTOP = 0x01
_USAGES: dict[Kind, tuple[int, ...]] = {"gamepad": (0x04, 0x05), "spacemouse": (0x08,)}
"""Joystick and gamepad; multi-axis controller."""
THREEDCONNEXION = 0x256F
_LOGITECH = 0x046D
"""Manufacturer of the first models."""


@attrs.frozen
class Model:
    """A device with publicly documented reports."""

    name: str
    kind: Kind
    start: Callable[[], Parse]
    """Creates the parser for one connection."""
    ids: tuple[tuple[int, int], ...] = ()
    """Vendor and product."""
    streams: bool = False
    """Whether it sends reports continuously, so that silence means that it is out of range."""
    opening: tuple[bytes, ...] = ()
    """Reports to write when it is opened."""


MODELS = (
    Model("DualShock 4", "gamepad", lambda: parse_dualshock4,
          ((0x054C, 0x05C4), (0x054C, 0x09CC), (0x054C, 0x0BA0)), streams=True),
    Model("DualSense", "gamepad", lambda: parse_dualsense, ((0x054C, 0x0CE6), (0x054C, 0x0DF2)), streams=True),
    Model("Xbox One S (Bluetooth)", "gamepad", lambda: parse_xbox_one_s, ((0x045E, 0x02E0), (0x045E, 0x02FD))),
    Model("Xbox (Bluetooth)", "gamepad", lambda: parse_xbox,
          ((0x045E, 0x0B05), (0x045E, 0x0B13), (0x045E, 0x0B20), (0x045E, 0x0B22))),
    Model("Switch Pro", "gamepad", SwitchPro, ((0x057E, 0x2009),), streams=True, opening=OPENING),
    Model("8BitDo", "gamepad", lambda: parse_8bitdo,
          tuple((0x2DC8, product) for product in
                (0x6000, 0x6001, 0x6003, 0x6006, 0x6009, 0x6012, 0x6100, 0x6101))),
)  # fmt: skip
SPACE_MOUSE = Model("SpaceMouse", "spacemouse", SpaceMouse)


def model_of(vendor: int, product: int, usage_page: int, usage: int) -> Model | None:
    """The model of a HID interface, or None if its reports are unknown.

    Args:
        vendor: USB or Bluetooth vendor.
        product: the vendor's number of the product.
        usage_page: of the interface's top collection, by the HID usage tables.
        usage: of the same.
    """
    if usage_page != _GENERIC_DESKTOP:
        return None
    if usage in _USAGES["spacemouse"] and vendor in (THREEDCONNEXION, _LOGITECH):
        return SPACE_MOUSE
    if usage in _USAGES["gamepad"]:
        return next((model for model in MODELS if (vendor, product) in model.ids), None)
    return None
