"""Kinematics of arms: forward and inverse kinematics, Jacobians and servo, from an MJCF."""

from ibrobot_kinematics.errors import KinematicsError, UnreachableError
from ibrobot_kinematics.inverse import solve, solve_all
from ibrobot_kinematics.jog_arm import JogArm, JogMotion, VelocityJog
from ibrobot_kinematics.mjcf import read_mjcf, robot_model
from ibrobot_kinematics.model import ChainJoint, KinematicModel, TipPose
from ibrobot_kinematics.servo import Servo, ServoOptions, ServoStatus
from ibrobot_kinematics.target import Target

__all__ = [
    "ChainJoint", "JogArm", "JogMotion", "KinematicModel", "KinematicsError", "Servo", "ServoOptions", "ServoStatus",
    "Target", "TipPose", "UnreachableError", "VelocityJog", "read_mjcf", "robot_model", "solve", "solve_all",
]  # fmt: skip
