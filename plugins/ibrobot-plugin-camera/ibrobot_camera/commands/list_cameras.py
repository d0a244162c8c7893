"""`ibrobot camera list`: the V4L2 devices of this machine and the pictures that they offer."""

from __future__ import annotations

import json

import attrs
import click
from rich.console import Console
from rich.table import Table

from ibrobot_camera import v4l2


@click.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_cameras(as_json: bool) -> None:
    """List the cameras of this machine: path, stable id, name, and formats, sizes and rates."""
    found = v4l2.cameras()
    if as_json:
        click.echo(json.dumps([attrs.asdict(camera) for camera in found], indent=2))
        return
    if not found:
        click.echo("no camera: there is no /dev/video*; is it plugged in, and does `lsusb` show it?")
        return
    console = Console()
    for camera in found:
        console.print(f"[bold]{camera.path}[/bold]  {camera.name}")
        if camera.stable_id:
            console.print(f"  device: {camera.stable_id}", soft_wrap=True)
        if camera.problem:
            console.print(f"  [red]{camera.problem}[/red]: sudo usermod -aG video $USER, log in anew")
        else:
            console.print(_table(camera))


def _table(camera: v4l2.Camera) -> Table:
    table = Table(box=None, padding=(0, 2))
    for heading in ("format", "size", "rates [Hz]"):
        table.add_column(heading)
    for mode in camera.modes:
        table.add_row(mode.fourcc, f"{mode.width}x{mode.height}", ", ".join(f"{rate:g}" for rate in mode.rates_hz))
    return table
