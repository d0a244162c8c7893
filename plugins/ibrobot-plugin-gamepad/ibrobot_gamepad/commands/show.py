"""`ibrobot gamepad list`, `test` and `udev`: the devices, what their controls do, and who may open them."""

from __future__ import annotations

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import echo
from ibrobot_gamepad.commands.devices import OnDevice, find_all, opened, watch
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.permissions import udev_rules

_VIA = {"hid": "its own reports", "sdl": "SDL"}
_STEP = 0.05
"""Change of an axis before it is shown again."""


@attrs.frozen
class ListDevices:
    """List gamepads and SpaceMice.

    It shows name, id for the option `device`, model, and how each is read.
    """

    def __call__(self) -> list[dict[str, str]]:
        return [
            {
                "type": kind,
                "name": each.name,
                "device": each.id,
                "model": each.model,
                "via": each.via,
                "path": each.path,
            }
            for kind, each in find_all()
        ]

    def show(self, devices: list[dict[str, str]]) -> None:
        """Print a table."""
        if not devices:
            echo("no gamepad or SpaceMouse is plugged in; `ibrobot doctor` names those without permission")
            return
        columns = ("type", "name", "device", "model")
        table = [(*(each[column] for column in columns), f"read by {_VIA[each['via']]}") for each in devices]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        for row in table:
            echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


@attrs.frozen(kw_only=True)
class ShowControls(OnDevice):
    """Show the axes and buttons of a device as they change. Ctrl-C ends it."""

    seconds: float = option(60.0, ge=0, help="stop after this time")

    def __call__(self) -> None:
        last = ""

        def tell(controls: Controls) -> bool:
            nonlocal last
            line = describe(controls)
            if line != last:
                last = line
                echo(line)
            return False

        with opened(self.device) as (_, listed, open_device):
            echo(f"{listed.name} ({listed.id}, {listed.model}): move its axes, press its buttons")
            watch(open_device, self.seconds, tell)


def describe(controls: Controls) -> str:
    """Deflected axes and pressed buttons, on one line."""
    axes = {name: round(value / _STEP) * _STEP for name, value in controls.axes.items()}
    parts = [f"{name} {value:+.2f}" for name, value in axes.items() if value] + sorted(controls.buttons)
    return "  ".join(parts) or "at rest"


@attrs.frozen
class Udev:
    """Print the udev rule that lets users open devices.

    It covers gamepads and SpaceMice, for the user logged in at this machine.
    """

    def __call__(self) -> None:
        echo(udev_rules())
