"""`ibrobot gamepad list`, `test` and `udev`: the devices, what their controls do, and who may open them."""

from __future__ import annotations

import json

import click

from ibrobot_core.app import echo
from ibrobot_gamepad.commands.devices import device_option, find_all, opened, watch
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.permissions import udev_rules

_VIA = {"hid": "its own reports", "sdl": "SDL"}
_STEP = 0.05
"""Change of an axis before it is shown again."""


@click.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_devices(as_json: bool) -> None:
    """List gamepads and SpaceMice.

    It shows name, id for the option `device`, model, and how each is read.
    """
    devices = find_all()
    if as_json:
        rows = [
            {
                "type": kind,
                "name": each.name,
                "device": each.id,
                "model": each.model,
                "via": each.via,
                "path": each.path,
            }
            for kind, each in devices
        ]
        echo(json.dumps(rows, indent=2))
        return
    if not devices:
        echo("no gamepad or SpaceMouse is plugged in; `ibrobot doctor` names those without permission")
        return
    table = [(kind, each.name, each.id, each.model, f"read by {_VIA[each.via]}") for kind, each in devices]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


@click.command("test")
@device_option
@click.option("--seconds", type=click.FloatRange(min=0), default=60.0, show_default=True, help="Stop after this time.")
def show(device: str, seconds: float) -> None:
    """Show the axes and buttons of a device as they change. Ctrl-C ends it."""
    last = ""

    def tell(controls: Controls) -> bool:
        nonlocal last
        line = describe(controls)
        if line != last:
            last = line
            echo(line)
        return False

    with opened(device) as (_, listed, open_device):
        echo(f"{listed.name} ({listed.id}, {listed.model}): move its axes, press its buttons")
        watch(open_device, seconds, tell)


def describe(controls: Controls) -> str:
    """Deflected axes and pressed buttons, on one line."""
    axes = {name: round(value / _STEP) * _STEP for name, value in controls.axes.items()}
    parts = [f"{name} {value:+.2f}" for name, value in axes.items() if value] + sorted(controls.buttons)
    return "  ".join(parts) or "at rest"


@click.command()
def udev() -> None:
    """Print the udev rule that lets users open devices.

    It covers gamepads and SpaceMice, for the user logged in at this machine.
    """
    echo(udev_rules())
