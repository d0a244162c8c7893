"""`ibrobot gamepad test`: shows deflected axes and pressed buttons."""

from __future__ import annotations

import click

from ibrobot_core.app import echo
from ibrobot_gamepad.commands.devices import device_option, opened, watch
from ibrobot_gamepad.controls import Controls

_STEP = 0.05
"""Change of an axis before it is shown again."""


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

    with opened(device) as (_, found, open_device):
        echo(f"{found.name} ({found.id}, {found.model}): move its axes, press its buttons")
        watch(open_device, seconds, tell)


def describe(controls: Controls) -> str:
    """Deflected axes and pressed buttons, on one line."""
    axes = {name: round(value / _STEP) * _STEP for name, value in controls.axes.items()}
    parts = [f"{name} {value:+.2f}" for name, value in axes.items() if value] + sorted(controls.buttons)
    return "  ".join(parts) or "at rest"
