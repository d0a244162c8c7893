"""The plugin's hooks: teleops `gamepad` and `spacemouse`, `ibrobot gamepad …`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import Check, TeleopDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_gamepad.options import GamepadOptions, SpaceMouseOptions

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import Context, OperatorEvent, OptionFault, Robot, Teleop


def _jog(options: Any, ctx: Context) -> Teleop:
    from ibrobot_gamepad.teleop import JogTeleop

    return JogTeleop(options, ctx)


def _check(options: Any, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_gamepad.mapping import check_mapping

    return check_mapping(options, robot)


def _events(options: Any) -> Collection[OperatorEvent]:
    from ibrobot_gamepad.mapping import events

    return events(options)


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Jog with the hands on a device."""
    yield TeleopDescriptor(
        type="gamepad",
        options=GamepadOptions,
        make=_jog,
        check_options=_check,
        events=_events,
        label="drive with a gamepad",
        summary="joint and tool jog with an Xbox, PlayStation, Switch, 8BitDo or other pad",
    )
    yield TeleopDescriptor(
        type="spacemouse",
        options=SpaceMouseOptions,
        make=_jog,
        check_options=_check,
        events=_events,
        label="drive with a SpaceMouse",
        summary="joint and tool jog with a SpaceMouse",
    )


def _commands() -> click.Command:
    from ibrobot_gamepad.commands import gamepad

    return gamepad


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot gamepad …`."""
    yield Command("gamepad", "List, test and map gamepads and SpaceMice.", _commands)


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check which devices the user may open."""
    from ibrobot_gamepad.permissions import checks

    return checks()
