"""Options of `type: keyboard`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import attrs

from ibrobot_core.api import documented, option

RESERVED = ("q", "esc", "tab", *(f"f{n}" for n in range(1, 13)))
"""Keys that belong to `ibrobot launch`: quit, emergency stop, modes, reset."""


def _check_keys(instance: Any, attribute: attrs.Attribute[Any], keys: Mapping[str, str]) -> None:
    for action, key in keys.items():
        if key in RESERVED:
            raise ValueError(f"{action}: key {key!r} is reserved by ibrobot; reserved keys are {', '.join(RESERVED)}")


@documented
@attrs.frozen
class KeyboardOptions:
    """Options of `type: keyboard`; the joints' limits bound every speed."""

    joint_speed: float = option(0.5, unit="rad/s", gt=0, help="speed of joints, and of turning the tool")
    cartesian_speed: float = option(0.1, unit="m/s", gt=0, help="speed of the tool")
    gripper_speed: float = option(1.0, unit="rad/s", gt=0, help="speed of opening and closing")
    hold: float = option(
        0.15, unit="s", gt=0, le=1, help="how long one key press moves; must exceed the terminal's auto-repeat interval"
    )
    cartesian: bool = option(True, help="whether Cartesian jog is available; it needs robot.description.mjcf")
    gripper: str = option("gripper", help="joint group that the gripper keys move")
    keys: Mapping[str, str] = option(factory=dict, help="action -> key, instead of the default", validator=_check_keys)
