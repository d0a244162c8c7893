"""The packages that add devices to LeRobot, for the run and for device processes."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import Distribution

_PREFIXES = ("lerobot_robot_", "lerobot_teleoperator_", "lerobot_camera_")
"""LeRobot imports the distributions whose names begin with one of these."""
KEEPS_TORQUE = "disable_torque_on_disconnect"
"""The key of LeRobot's configs that decides about the torque after the end; here `control.stop` does."""


def third_parties(installed: Iterable[Distribution]) -> list[str]:
    """The modules of packages that add devices to LeRobot, also of those with dashes, which LeRobot overlooks.

    Not those of ibrobot itself: LeRobot's way to a robot of ibrobot is no way for ibrobot.
    """
    names = {module_of(each) for each in installed}
    return sorted(name for name in names if name.startswith(_PREFIXES) and not name.endswith("_ibrobot"))


def module_of(distribution: Distribution) -> str:
    """The module of a distribution of LeRobot's kind."""
    return str(distribution.metadata["Name"]).replace("-", "_")
