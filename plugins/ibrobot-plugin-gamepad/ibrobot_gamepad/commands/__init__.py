"""`ibrobot gamepad …`: lists, tests and maps gamepads and SpaceMice; one file per command."""

from __future__ import annotations

import click

from ibrobot_gamepad.commands.list_devices import list_devices
from ibrobot_gamepad.commands.map_controls import map_controls
from ibrobot_gamepad.commands.show import show
from ibrobot_gamepad.commands.udev import udev


@click.group()
def gamepad() -> None:
    """List, test and map gamepads and SpaceMice."""


for command in (list_devices, show, map_controls, udev):
    gamepad.add_command(command)
