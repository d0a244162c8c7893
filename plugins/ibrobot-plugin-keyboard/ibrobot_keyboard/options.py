"""Options of `type: keyboard`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import OptionFault, Options, TeleopError, documented, option
from ibrobot_keyboard.keymap import Keymap, make_keymap

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


@documented
@attrs.frozen
class KeyboardOptions(Options):
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

    def keymap(self, robot: Robot) -> Keymap:
        """The key bindings of a robot.

        Raises:
            TeleopError: as `make_keymap`.
        """
        gripper = robot.groups.get(self.gripper, ())
        return make_keymap(
            [name for name in robot.joint_names if name not in gripper],
            cartesian=self.cartesian,
            gripper=bool(gripper),
            home="home" in robot.description.poses,
            overrides=self.keys,
        )

    def terminal_keys(self, robot: Robot) -> Mapping[str, str]:
        """Key -> what it does; nothing for options with faults, which `check` yields."""
        try:
            keymap = self.keymap(robot)
        except TeleopError:
            return {}
        actions = {**keymap.cartesian, **keymap.joints, **keymap.common}
        return {key: action for action, key in actions.items()}

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that joints have keys for both directions, each key has one action, and Cartesian jog has a model."""
        if self.cartesian and robot.description.mjcf is None:
            yield OptionFault(
                ("cartesian",), "Cartesian jog needs robot.description.mjcf: set it, or cartesian: false", "mjcf"
            )
        try:
            self.keymap(robot)
        except TeleopError as error:
            yield OptionFault(("keys",), str(error).removeprefix("keys: "))
