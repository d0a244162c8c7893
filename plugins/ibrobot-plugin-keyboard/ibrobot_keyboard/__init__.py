"""The plugin's hooks: teleop `keyboard`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, TeleopDescriptor, hookimpl
from ibrobot_keyboard.options import KeyboardOptions


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Jog from the terminal."""
    yield TeleopDescriptor(
        type="keyboard",
        options=KeyboardOptions,
        make=Late("ibrobot_keyboard.teleop:KeyboardTeleop"),
        summary="joint and Cartesian jog from the terminal",
        label="drive by keys of the terminal",
    )
