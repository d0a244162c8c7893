"""Kinematics of arms: forward and inverse kinematics, Jacobians and servo, from an MJCF.

Names are imported on first use, so that plugins can describe their options without NumPy.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ibrobot_kinematics.clearance import world_clearance
    from ibrobot_kinematics.constraints import ToolConstraints
    from ibrobot_kinematics.errors import KinematicsError, UnreachableError
    from ibrobot_kinematics.inverse import solve, solve_all
    from ibrobot_kinematics.jog_arm import JogArm, JogMotion, VelocityJog
    from ibrobot_kinematics.mjcf import read_mjcf, robot_model
    from ibrobot_kinematics.model import ChainJoint, KinematicModel, TipPose
    from ibrobot_kinematics.path_constraints import PathConstraints
    from ibrobot_kinematics.servo import Servo, ServoStatus
    from ibrobot_kinematics.servo_options import ServoOptions
    from ibrobot_kinematics.target import Target

__all__ = [
    "ChainJoint", "JogArm", "JogMotion", "KinematicModel", "KinematicsError", "PathConstraints", "Servo",
    "ServoOptions", "ServoStatus", "Target", "TipPose", "ToolConstraints", "UnreachableError", "VelocityJog",
    "read_mjcf", "robot_model", "solve", "solve_all", "world_clearance",
]  # fmt: skip

_HOMES = {
    "clearance": ("world_clearance",),
    "constraints": ("ToolConstraints",),
    "errors": ("KinematicsError", "UnreachableError"),
    "inverse": ("solve", "solve_all"),
    "jog_arm": ("JogArm", "JogMotion", "VelocityJog"),
    "mjcf": ("read_mjcf", "robot_model"),
    "model": ("ChainJoint", "KinematicModel", "TipPose"),
    "path_constraints": ("PathConstraints",),
    "servo": ("Servo", "ServoStatus"),
    "servo_options": ("ServoOptions",),
    "target": ("Target",),
}
"""Module -> its names."""


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{module}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
