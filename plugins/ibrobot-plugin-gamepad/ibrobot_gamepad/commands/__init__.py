"""`ibrobot gamepad …`: lists, tests and maps gamepads and SpaceMice."""

from __future__ import annotations

import click

from ibrobot_gamepad.commands.map_controls import map_controls
from ibrobot_gamepad.commands.show import list_devices, show, udev


@click.group()
def gamepad() -> None:
    """List, test and map gamepads and SpaceMice."""


for command in (list_devices, show, map_controls, udev):
    gamepad.add_command(command)
