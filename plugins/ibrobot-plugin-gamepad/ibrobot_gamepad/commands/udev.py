"""`ibrobot gamepad udev`: the udev rule that lets users open the devices."""

from __future__ import annotations

import click

from ibrobot_core.api import echo
from ibrobot_gamepad.permissions import udev_rules


@click.command()
def udev() -> None:
    """Print the udev rule that lets the user logged in at this machine open gamepads and SpaceMice."""
    echo(udev_rules())
