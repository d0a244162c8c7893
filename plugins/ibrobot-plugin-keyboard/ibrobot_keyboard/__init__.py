"""The plugin's hooks: teleop `keyboard`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import Late, TeleopDescriptor, hookimpl
from ibrobot_keyboard.options import KeyboardOptions

if TYPE_CHECKING:
    from ibrobot_core.api import OptionFault, Robot


def _check(options: Any, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_keyboard.keymap import check_keys

    return check_keys(options, robot)


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Jog from the terminal."""
    yield TeleopDescriptor(
        type="keyboard",
        options=KeyboardOptions,
        make=Late("ibrobot_keyboard.teleop:KeyboardTeleop"),
        check_options=_check,
        keys=Late("ibrobot_keyboard.keymap:keys_of"),
        needs_terminal=lambda options: True,
        summary="joint and Cartesian jog from the terminal",
        label="drive by keys of the terminal",
    )
