"""The device that a command works with."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import attrs

from ibrobot_core.api import TeleopError, option
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.devices import Device, DeviceGone, Found
from ibrobot_gamepad.finder import Finder, open_first
from ibrobot_gamepad.reports import KINDS, Kind

_POLL_S = 0.01


@attrs.frozen(kw_only=True)
class OnDevice:
    """The options of a command that works with a device."""

    device: str = option(
        "", typed="--device ID", help="VENDOR:PRODUCT, as `ibrobot gamepad list` prints; by default the first"
    )


def find_all(kinds: tuple[Kind, ...] = KINDS) -> list[tuple[Kind, Found]]:
    """All connected devices, with their kinds; a pad found by both hidapi and SDL appears once."""
    devices: list[tuple[Kind, Found]] = []
    for kind in kinds:
        with closing(Finder(kind)) as finder:
            devices += [(kind, each) for each in finder.find()]
    read = {(each.vendor, each.product) for _, each in devices if each.via == "hid"}
    return [(kind, each) for kind, each in devices if each.via == "hid" or (each.vendor, each.product) not in read]


@contextmanager
def opened(wanted: str) -> Iterator[tuple[Kind, Found, Device]]:
    """Open the device that `--device` names, or the first.

    Raises:
        TeleopError: where none is plugged in, or it cannot be opened.
    """
    for kind in KINDS:
        with closing(Finder(kind)) as finder:
            result = open_first(finder.find(), wanted)
            if result is not None:
                listed, device = result
                with closing(device):
                    yield kind, listed, device
                return
    which = f" {wanted}" if wanted else ""
    raise TeleopError(f"no gamepad or SpaceMouse{which} is plugged in; `ibrobot gamepad list` shows all")


def watch(device: Device, seconds: float, see: Callable[[Controls], bool]) -> bool:
    """Call `see` with each state until it returns True; returns False after the timeout.

    Raises:
        TeleopError: when the device is unplugged.
    """
    end = time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            if any(see(controls) for controls in device.poll(time.monotonic_ns())):
                return True
            time.sleep(_POLL_S)
    except DeviceGone as error:
        raise TeleopError(f"the device is gone: {error}") from error
    return False
