"""`ibrobot gamepad udev`: the udev rule that lets users open the devices."""

from __future__ import annotations

import click

from ibrobot_core.app import echo
from ibrobot_gamepad.permissions import udev_rules


@click.command()
def udev() -> None:
    """Print the udev rule that lets users open devices.

    It covers gamepads and SpaceMice, for the user logged in at this machine.
    """
    echo(udev_rules())
