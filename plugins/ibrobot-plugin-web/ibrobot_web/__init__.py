"""The plugin's hooks: viewer and teleop `web`, the commands `ibrobot ui` and `ibrobot config copy`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, TeleopDescriptor, ViewerDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_web.options import WebOptions, WebTeleopOptions


@hookimpl
def ibrobot_viewers() -> Iterable[ViewerDescriptor]:
    """A page in the browser."""
    yield ViewerDescriptor(
        type="web",
        options=WebOptions,
        make=Late("ibrobot_web.viewer:WebViewer"),
        flag="--web",
        begins_episodes=True,
        summary="a page in the browser, which shows and drives the robot",
    )


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Jog from the page."""
    yield TeleopDescriptor(
        type="web",
        options=WebTeleopOptions,
        make=Late("ibrobot_web.teleop:WebTeleop"),
        label="drive from the page",
        summary="joint and tool jog from the page of the viewer web, while a button is held",
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot ui` and `ibrobot config copy`."""
    yield Command("ui", Late("ibrobot_web.ui.command:ServeUi"), "Set up, launch and record robots in the browser.")
    summary = "Copy a robot YAML, with your ports and cameras."
    yield Command("config copy", Late("ibrobot_web.ui.copying:CopyConfig"), summary)
