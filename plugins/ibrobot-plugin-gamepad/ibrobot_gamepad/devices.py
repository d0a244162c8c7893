"""A connected device, and the interface of an open one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal

import attrs

from ibrobot_gamepad.controls import Controls

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
