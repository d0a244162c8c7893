"""The hands of a robot: the links that touch what it grasps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ibrobot_kinematics import robot_model
from ibrobot_kinematics.errors import KinematicsError

from ibrobot_core.api import Robot

if TYPE_CHECKING:
    from ibrobot_planning.world.arm import Arm


def hands(robot: Robot, arm: Arm) -> tuple[str, ...]:
    """The links behind the last joint that moves the tool, of each arm; none for a model without the tool."""
    prefixes = tuple(robot.description.arms) or ("",)
    links: list[str] = []
    for prefix in prefixes:
        joints = [name for name in robot.joint_names if robot.description.arm_of(name) == prefix]
        try:
            model = robot_model(robot, joints)
        except KinematicsError:  # e.g. a tip of the URDF alone
            continue
        links += arm.hand(model.joint_names[model.chain[-1].index]) if model.chain else ()
    return tuple(links)
