"""Options of `type: keyboard`."""

from __future__ import annotations

from collections.abc import Mapping

import attrs

from ibrobot_core.api import documented, option


@documented
@attrs.frozen
class KeyboardOptions:
    """Options of `type: keyboard`; the joints' limits bound every speed."""

    joint_speed: float = option(0.5, unit="rad/s", gt=0, help="speed of joints, and of turning the tool")
    cartesian_speed: float = option(0.1, unit="m/s", gt=0, help="speed of the tool")
    gripper_speed: float = option(1.0, unit="rad/s", gt=0, help="speed of opening and closing")
    hold: float = option(
        0.15,
        unit="s",
        gt=0,
        le=0.2,
        help="how long one key press moves; must exceed the terminal's auto-repeat interval",
    )
    cartesian: bool = option(True, help="whether Cartesian jog is available; it needs robot.description.mjcf")
    gripper: str = option("gripper", help="joint group that the gripper keys move")
    keys: Mapping[str, str] = option(factory=dict, help="action -> key, instead of the default")
