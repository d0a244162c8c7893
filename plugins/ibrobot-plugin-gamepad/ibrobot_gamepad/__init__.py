"""The plugin's hooks: teleops `gamepad` and `spacemouse`, `ibrobot gamepad …`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Check, Late, TeleopDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_gamepad.options import GamepadOptions, SpaceMouseOptions


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Jog with the hands on a device."""
    yield TeleopDescriptor(
        type="gamepad",
        options=GamepadOptions,
        make=Late("ibrobot_gamepad.teleop:JogTeleop"),
        label="drive with a gamepad",
        summary="joint and tool jog with an Xbox, PlayStation, Switch, 8BitDo or other pad",
    )
    yield TeleopDescriptor(
        type="spacemouse",
        options=SpaceMouseOptions,
        make=Late("ibrobot_gamepad.teleop:JogTeleop"),
        label="drive with a SpaceMouse",
        summary="joint and tool jog with a SpaceMouse",
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot gamepad …`."""
    yield Command("gamepad", summary="List, test and map gamepads and SpaceMice.")
    yield Command("gamepad list", Late("ibrobot_gamepad.commands.show:ListDevices"))
    yield Command("gamepad test", Late("ibrobot_gamepad.commands.show:ShowControls"))
    yield Command("gamepad map", Late("ibrobot_gamepad.commands.map_controls:MapControls"))
    yield Command("gamepad udev", Late("ibrobot_gamepad.commands.show:Udev"))


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check which devices the user may open."""
    from ibrobot_gamepad.permissions import checks

    return checks()
