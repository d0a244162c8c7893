"""Poses as homogeneous matrices, and back."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Pose, Quaternion, Vector, Vector3


def rotation(w: float, x: float, y: float, z: float) -> Vector:
    """Rotation matrix of a quaternion of any length above 0, shape (3, 3)."""
    w, x, y, z = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix(pose: Pose) -> Vector:
    """A pose as a homogeneous matrix, shape (4, 4)."""
    placed = np.eye(4)
    q, p = pose.orientation, pose.position
    placed[:3, :3] = rotation(q.w, q.x, q.y, q.z)
    placed[:3, 3] = p.x, p.y, p.z
    return placed


def pose(placed: Vector) -> Pose:
    """A homogeneous matrix, shape (4, 4), as a pose."""
    r = placed[:3, :3]
    # The largest of the four components is found first, so that nothing small is divided by.
    squares = np.array([
        1 + r[0, 0] + r[1, 1] + r[2, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2],
        1 - r[0, 0] + r[1, 1] - r[2, 2], 1 - r[0, 0] - r[1, 1] + r[2, 2],
    ])  # fmt: skip
    largest = int(np.argmax(squares))
    products = np.array(
        [
            [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], squares[1], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], squares[2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[3]],
        ]
    )
    w, x, y, z = (products[largest] / np.linalg.norm(products[largest])).tolist()
    return Pose(Vector3(*placed[:3, 3].tolist()), Quaternion(x, y, z, w))


def from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Quaternion of turns [rad] about the fixed x, then y, then z axis, as in URDF."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(np.array([roll, pitch, yaw]) / 2), np.cos(np.array([roll, pitch, yaw]) / 2)
    return Quaternion(
        float(sr * cp * cy - cr * sp * sy),
        float(cr * sp * cy + sr * cp * sy),
        float(cr * cp * sy - sr * sp * cy),
        float(cr * cp * cy + sr * sp * sy),
    )


def to_rpy(q: Quaternion) -> tuple[float, float, float]:
    """Turns [rad] about the fixed x, then y, then z axis of a quaternion; the inverse of `from_rpy`."""
    r = rotation(q.w, q.x, q.y, q.z)
    across = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = float(np.arctan2(-r[2, 0], across))
    if across < 1e-9:  # x and z axis coincide: one turn does for both
        return float(np.arctan2(-r[1, 2], r[1, 1])), pitch, 0.0
    return float(np.arctan2(r[2, 1], r[2, 2])), pitch, float(np.arctan2(r[1, 0], r[0, 0]))
