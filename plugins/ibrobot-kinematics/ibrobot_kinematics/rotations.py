"""Rotations: matrices, and their forms as rotation vectors, quaternions and roll, pitch, yaw.

A rotation vector is the axis times the angle [rad]. Quaternions are (x, y, z, w), as in ROS. Roll, pitch and yaw are
turns [rad] about the fixed x, then y, then z axis, as in URDF.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ibrobot_core.api import Vector

_NO_SINE = 1e-6
"""Sine of the angle below which the antisymmetric part of a matrix does not determine the axis."""

_PARALLEL = 1e-8
"""Sine of the angle between two directions below which their cross product does not determine an axis."""
_NO_LEVEL = 1e-9
"""Horizontal part of the x axis below which yaw has no direction."""
_IDENTITY = np.eye(3)
_AFTER, _BEFORE = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: Vector, b: Vector) -> Vector:
    """Cross products along the last axis, shape (…, 3); several times faster than `numpy.cross` for few vectors."""
    return a.take(_AFTER, -1) * b.take(_BEFORE, -1) - a.take(_BEFORE, -1) * b.take(_AFTER, -1)


def skew(v: Vector) -> Vector:
    """The matrix K, shape (3, 3), with `K @ x == cross(v, x)`."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(v: Vector) -> Vector:
    """Matrix, shape (3, 3), of a rotation vector, shape (3,)."""
    angle = math.hypot(*v.tolist())
    k = skew(v)
    # With the square of a sine both factors stay exact for small angles.
    return np.asarray(_IDENTITY + _sinc(angle) * k + _sinc(angle / 2) ** 2 / 2 * k @ k)


def _sinc(x: float) -> float:
    return math.sin(x) / x if x else 1.0


def log(rotation: Vector) -> Vector:
    """Rotation vectors, shape (…, 3), of matrices, shape (…, 3, 3); their length is at most pi."""
    r = rotation
    sine = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1) / 2
    length, cosine = np.linalg.norm(sine, axis=-1), (np.trace(r, axis1=-2, axis2=-1) - 1) / 2
    small = length <= _NO_SINE
    angle = np.arctan2(length, cosine)
    vector = np.asarray(sine * np.where(small, 1.0, angle / np.where(small, 1.0, length))[..., None])
    half = small & (cosine <= 0)
    if half.any():
        # Near half a turn, the symmetric part, cos I + (1 - cos) a aT, determines the axis.
        symmetric = (r + r.mT)[half] / 2 - cosine[half][:, None, None] * np.eye(3)
        largest = np.argmax(np.diagonal(symmetric, axis1=-2, axis2=-1), axis=-1)
        axis = np.take_along_axis(symmetric, largest[:, None, None], axis=-1)[..., 0]
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        axis *= np.where((axis * sine[half]).sum(axis=-1) < 0, -1.0, 1.0)[:, None]
        vector[half] = axis * angle[half][:, None]
    return vector


def between(a: Vector, b: Vector) -> Vector:
    """Rotation vector, shape (3,), of the shortest rotation from one unit vector to another.

    For opposite vectors, it is any of the half turns.
    """
    normal = cross(a, b)
    sine, cosine = math.hypot(*normal.tolist()), float(a @ b)
    if sine < _PARALLEL:  # no turn, or half a turn about any axis perpendicular to both
        normal = cross(a, _IDENTITY[int(np.abs(a).argmin())])
    return normal * (math.atan2(sine, cosine) / math.hypot(*normal.tolist()))


def from_quaternion(q: ArrayLike) -> Vector:
    """Matrix, shape (3, 3), of a quaternion (x, y, z, w) of any length above 0."""
    x, y, z, w = np.asarray(q, dtype=float) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(rotation: Vector) -> Vector:
    """Unit quaternion (x, y, z, w), shape (4,), of a matrix, shape (3, 3); w is not negative."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    # Four times the products of the quaternion's components; the row of the largest one loses no digits.
    products = (
        (1 + xx - yy - zz, xy + yx, xz + zx, zy - yz),
        (xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx),
        (xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy),
        (zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
    )
    row = products[max(range(4), key=lambda i: products[i][i])]
    return np.array(row) / math.copysign(math.hypot(*row), row[3])


def from_rpy(roll: float, pitch: float, yaw: float) -> Vector:
    """Matrix, shape (3, 3), of roll, pitch and yaw [rad]."""
    (sr, sp, sy), (cr, cp, cy) = (tuple(map(turn, (roll, pitch, yaw))) for turn in (math.sin, math.cos))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy(rotation: Vector) -> Vector:
    """Roll, pitch and yaw [rad], shape (3,), of a matrix, shape (3, 3); yaw is 0 if the x axis is vertical."""
    level = np.hypot(rotation[0, 0], rotation[1, 0])
    pitch = np.arctan2(-rotation[2, 0], level)
    if level < _NO_LEVEL:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll, yaw = np.arctan2(rotation[2, 1], rotation[2, 2]), np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.array([roll, pitch, yaw])
