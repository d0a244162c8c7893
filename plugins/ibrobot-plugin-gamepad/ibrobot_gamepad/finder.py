"""Finds the connected devices, by hidapi and SDL, and opens one."""

from __future__ import annotations

from collections.abc import Sequence

from ibrobot_core.api import TeleopError
from ibrobot_gamepad.devices import Device, Found
from ibrobot_gamepad.hid import find_hid
from ibrobot_gamepad.reports import Kind
from ibrobot_gamepad.sdl import find_sdl, start_sdl, stop_sdl


class Finder:
    """Finds the devices of a kind; those with known reports come first.

    Args:
        kind: gamepads or SpaceMice.
        via: `hid`, `sdl` or `auto` for both.

    Raises:
        TeleopError: where a library does not start.
    """

    def __init__(self, kind: Kind, via: str = "auto") -> None:
        self._kind = kind
        self._hid = via != "sdl"
        self._sdl = kind == "gamepad" and via != "hid"
        if self._sdl:
            start_sdl()

    def find(self) -> list[Found]:
        """The connected devices."""
        devices: list[Found] = []
        if self._hid:
            devices += find_hid(self._kind)
        if self._sdl:
            devices += find_sdl()
        return devices

    def close(self) -> None:
        """Release the libraries; close opened devices first. Safe to call twice."""
        if self._sdl:
            stop_sdl()
            self._sdl = False


def open_first(devices: Sequence[Found], wanted: str) -> tuple[Found, Device] | None:
    """Open the first device that matches; None if there is none.

    Raises:
        TeleopError: when no matching device can be opened; names the remedy.
    """
    refused: list[str] = []
    for each in devices:
        if each.matches(wanted):
            try:
                return each, each.open()
            except OSError as error:
                refused.append(f"{each.name} ({each.id}, {each.path or each.via}) cannot be opened: {error}")
    if refused:
        raise TeleopError("; ".join(refused) + "; `ibrobot doctor` says which permission is missing")
    return None
