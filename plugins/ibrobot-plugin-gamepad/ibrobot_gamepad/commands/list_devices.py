"""`ibrobot gamepad list`: the connected gamepads and SpaceMice."""

from __future__ import annotations

import json

import click

from ibrobot_core.app import echo
from ibrobot_gamepad.commands.devices import find_all

_VIA = {"hid": "its own reports", "sdl": "SDL"}


@click.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_devices(as_json: bool) -> None:
    """List gamepads and SpaceMice.

    It shows name, id for the option `device`, model, and how each is read.
    """
    found = find_all()
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
            for kind, each in found
        ]
        echo(json.dumps(rows, indent=2))
        return
    if not found:
        echo("no gamepad or SpaceMouse is plugged in; `ibrobot doctor` names those without permission")
        return
    table = [(kind, each.name, each.id, each.model, f"read by {_VIA[each.via]}") for kind, each in found]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
