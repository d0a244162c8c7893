"""`ibrobot camera list`: the V4L2 devices of this machine and the formats that they offer."""

from __future__ import annotations

import attrs
from ibrobot_terminal.screen import Screen, styled
from rich.table import Table

from ibrobot_camera import v4l2
from ibrobot_core.app import echo


@attrs.frozen
class ListCameras:
    """List the cameras of this machine.

    It shows path, stable id, USB port, name, and formats, sizes and rates of each.
    """

    def __call__(self) -> list[v4l2.Camera]:
        return v4l2.cameras()

    def show(self, connected: list[v4l2.Camera]) -> None:
        """Print them with their formats."""
        if not connected:
            echo("no camera: there is no /dev/video*; is it plugged in, and does `lsusb` show it?")
            return
        console = Screen()
        for camera in connected:
            console.print(styled(camera.path, "bold") + styled(f"  {camera.name}"))
            if camera.stable_id:
                console.print(f"  device: {camera.stable_id}", soft_wrap=True)
            if camera.usb_path:
                console.print(f"  device, by its USB port: {camera.usb_path}", soft_wrap=True)
            if camera.problem:
                console.print(
                    styled(f"  {camera.problem}", "red") + styled(": sudo usermod -aG video $USER, log in again")
                )
            else:
                console.print(_table(camera))


def _table(camera: v4l2.Camera) -> Table:
    table = Table(box=None, padding=(0, 2))
    for heading in v4l2.COLUMNS:
        table.add_column(heading)
    for mode in camera.modes:
        table.add_row(*mode.row)
    return table
