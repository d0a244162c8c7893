"""The joints that a command works on: names, servo ids, limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
from ibrobot_calibration import Calibration

from ibrobot_core.app import RequestError
from ibrobot_feetech.arm import Arm
from ibrobot_feetech.options import FollowerOptions

SO101 = {
    "shoulder_pan": (-1.91986, 1.91986),
    "shoulder_lift": (-1.74533, 1.74533),
    "elbow_flex": (-1.69, 1.69),
    "wrist_flex": (-1.65806, 1.65806),
    "wrist_roll": (-2.74385, 2.74385),
    "gripper": (-0.17453, 1.74533),
}
"""Joint -> limits [rad], in the order of servo ids from 1."""


@attrs.frozen
class Joint:
    """A joint and its servo."""

    name: str
    servo: int
    lower: float
    """[rad]"""
    upper: float
    """[rad]"""
    anchored: bool = False
    """Whether its angle is measured from its calibrated closed end rather than from its middle pose."""


def joints_of(robot: str | None = None, calibration: str | None = None, prefix: str = "") -> list[Joint]:
    """The joints of a robot YAML, or of an SO-101; servos have ids from 1 in that order.

    Args:
        robot: a path, or the name of a shipped config.
        calibration: selects the arm whose options name this calibration, if the robot has several arms.
        prefix: of the names of an SO-101's joints.

    Raises:
        ConfigError: if the config is invalid.
    """
    limits: Mapping[str, tuple[float, float]] = {f"{prefix}{joint}": ends for joint, ends in SO101.items()}
    anchored: tuple[str, ...] = (f"{prefix}gripper",)
    if robot is not None:
        from ibrobot_core.app import find_config, installed_plugins, load_config

        config = load_config(find_config(robot, installed_plugins()))
        arms = [arm for arm in config.hardware.values() if isinstance(arm.options, FollowerOptions)]
        arm = next((arm for arm in arms if arm.options.calibration == calibration), None)
        names = arm.joints if arm is not None else config.robot.joint_names
        anchored = arm.options.anchored if arm is not None else anchored
        limits = {joint.name: (joint.lower, joint.upper) for joint in config.robot.joints if joint.name in names}
    return [Joint(name, servo, *ends, name in anchored) for servo, (name, ends) in enumerate(limits.items(), 1)]


def chosen(joints: Sequence[Joint], names: Sequence[str]) -> list[Joint]:
    """The joints with these names; all if no name is given.

    Raises:
        RequestError: if a name is unknown.
    """
    known = {joint.name: joint for joint in joints}
    for name in names:
        if name not in known:
            raise RequestError(f"--joint: no joint {name!r}; available: {', '.join(known)}")
    return [known[name] for name in names] or list(joints)


def arm_of(joints: Sequence[Joint], calibration: Calibration) -> Arm:
    """The joints with a calibration that has them all."""
    closed = {joint.name: joint.lower for joint in joints if joint.anchored}
    return Arm(tuple(joint.name for joint in joints), calibration, closed)


def by_servo(joints: Sequence[Joint]) -> dict[int, str]:
    """Servo id -> joint."""
    return {joint.servo: joint.name for joint in joints}
