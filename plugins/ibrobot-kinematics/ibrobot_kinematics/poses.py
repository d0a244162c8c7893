"""Poses: messages, and homogeneous matrices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ibrobot_core.api import Pose, Quaternion, Vector, Vector3
from ibrobot_kinematics.rotations import from_quaternion, from_rpy, quaternion


def homogeneous(rotation: Vector, position: Vector) -> Vector:
    """A pose as a matrix, shape (4, 4)."""
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = rotation, position
    return placed


def matrix(pose: Pose) -> Vector:
    """A pose as a homogeneous matrix, shape (4, 4)."""
    p, q = pose.position, pose.orientation
    return homogeneous(from_quaternion((q.x, q.y, q.z, q.w)), np.array([p.x, p.y, p.z]))


def pose(placed: Vector) -> Pose:
    """A homogeneous matrix, shape (4, 4), as a pose."""
    return Pose(Vector3(*placed[:3, 3].tolist()), orientation(placed[:3, :3]))


def pose_at(position: Sequence[float], rpy: Sequence[float] = (0.0, 0.0, 0.0)) -> Pose:
    """The pose at a position [m] with roll, pitch and yaw [rad]."""
    return Pose(Vector3(*position), orientation(from_rpy(*rpy)))


def orientation(rotation: Vector) -> Quaternion:
    """A rotation matrix, shape (3, 3), as a quaternion whose w is not negative."""
    return Quaternion(*quaternion(rotation).tolist())
