"""The plugin's hooks: teleop `keyboard`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import TeleopDescriptor, hookimpl
from ibrobot_keyboard.options import KeyboardOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Context, OptionFault, Robot, Teleop


def _keyboard(options: Any, ctx: Context) -> Teleop:
    from ibrobot_keyboard.teleop import KeyboardTeleop

    return KeyboardTeleop(options, ctx)


def _check(options: Any, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_keyboard.keymap import check_keys

    return check_keys(options, robot)


def _keys(options: Any, robot: Robot) -> Mapping[str, str]:
    from ibrobot_keyboard.keymap import keys_of

    return keys_of(options, robot)


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Jog from the terminal."""
    yield TeleopDescriptor(
        type="keyboard",
        options=KeyboardOptions,
        make=_keyboard,
        check_options=_check,
        keys=_keys,
        needs_terminal=lambda options: True,
        summary="joint and Cartesian jog from the terminal",
        label="drive by keys of the terminal",
    )
