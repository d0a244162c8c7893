"""The SO-101 follower as a `Robot`, for benchmarks, tests and scripts that have no robot YAML."""

from __future__ import annotations

from pathlib import Path

from ibrobot_core.api import Description, Joint, Robot, resolve_path

MJCF = "package://so101_nexus/assets/SO101_menagerie/so101.xml"
_RANGES = {
    "shoulder_pan": (-1.91986, 1.91986),
    "shoulder_lift": (-1.74533, 1.74533),
    "elbow_flex": (-1.69, 1.69),
    "wrist_flex": (-1.65806, 1.65806),
    "wrist_roll": (-2.74385, 2.74385),
    "gripper": (-0.17453, 1.74533),
}


def so101() -> Robot:
    """The robot of `configs/so101.yaml`."""
    joints = tuple(
        Joint(name, lower, upper, max_velocity=3.0, max_acceleration=40.0) for name, (lower, upper) in _RANGES.items()
    )
    return Robot(
        name="so101",
        joints=joints,
        robot_type="so101_follower",
        groups={"arm": tuple(_RANGES)[:-1], "gripper": ("gripper",)},
        description=Description(
            mjcf=resolve_path(MJCF, Path()),
            poses={"home": (0.0,) * 6, "rest": (0.0, -1.57, 1.57, 0.79, 0.0, 0.0)},
        ),
    )
