"""Connected devices, and the interface of an open one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Literal

import attrs

from ibrobot_core.api import TeleopError
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.reports import Kind

Via = Literal["hid", "sdl"]


class DeviceGone(Exception):
    """The device was unplugged, switched off or moved out of range."""


class Device(ABC):
    """An open device.

    Attributes:
        streams: whether it reports continuously, so that silence means that it is lost; others report only changes.
    """

    streams = False

    @abstractmethod
    def poll(self, now_ns: int) -> list[Controls]:
        """The states sent since the last call, oldest first; never blocks.

        Args:
            now_ns: the time [ns], for detecting the silence of a device that sends continuously.

        Raises:
            DeviceGone: when it is no longer there.
        """

    @abstractmethod
    def close(self) -> None:
        """Release it. Safe to call twice."""


@attrs.frozen
class Found:
    """A connected device."""

    name: str
    vendor: int
    product: int
    serial: str
    model: str
    """Model of its reports, or its name in SDL."""
    via: Via
    open: Callable[[], Device] = attrs.field(eq=False, repr=False)
    """Opens it.

    Raises:
        OSError: e.g. without the permission.
    """
    path: str = ""

    @property
    def id(self) -> str:
        """Id for the option `device`."""
        return f"{self.vendor:04x}:{self.product:04x}" + (f":{self.serial}" if self.serial else "")

    def matches(self, wanted: str) -> bool:
        """Whether the option `device` names it."""
        own, asked = self.id.split(":", 2), wanted.split(":", 2)
        return not wanted or [part.lower() for part in own[: len(asked)]] == [part.lower() for part in asked]


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
            from ibrobot_gamepad.sdl import start_sdl

            start_sdl()

    def find(self) -> list[Found]:
        """The connected devices."""
        found: list[Found] = []
        if self._hid:
            from ibrobot_gamepad.hid import find_hid

            found += find_hid(self._kind)
        if self._sdl:
            from ibrobot_gamepad.sdl import find_sdl

            found += find_sdl()
        return found

    def close(self) -> None:
        """Release the libraries; close opened devices first. Safe to call twice."""
        if self._sdl:
            from ibrobot_gamepad.sdl import stop_sdl

            stop_sdl()
            self._sdl = False


def open_first(found: Sequence[Found], wanted: str) -> tuple[Found, Device] | None:
    """Open the first device that matches; None if there is none.

    Raises:
        TeleopError: when no matching device can be opened; names the remedy.
    """
    refused: list[str] = []
    for each in found:
        if each.matches(wanted):
            try:
                return each, each.open()
            except OSError as error:
                refused.append(f"{each.name} ({each.id}, {each.path or each.via}) cannot be opened: {error}")
    if refused:
        raise TeleopError("; ".join(refused) + "; `ibrobot doctor` says which permission is missing")
    return None
