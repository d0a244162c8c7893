"""`ibrobot camera …`: lists and previews cameras; one file per command."""

from __future__ import annotations

import click

from ibrobot_camera.commands.list_cameras import list_cameras
from ibrobot_camera.commands.preview import preview
from ibrobot_camera.commands.snapshot import snapshot


@click.group()
def camera() -> None:
    """List and preview cameras, and save snapshots.

    SOURCE is a device as in a robot YAML (a number, a path, a stable id, a URL, a video file), or a robot YAML, which
    means all its `opencv` cameras.
    """


for command in (list_cameras, preview, snapshot):
    camera.add_command(command)
