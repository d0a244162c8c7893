"""Rotations as matrices and as rotation vectors: the axis times the angle [rad]."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Vector

_NO_SINE = 1e-6
"""Below this sine of the angle the antisymmetric part of a matrix no longer gives the axis."""


def cross(a: Vector, b: Vector) -> Vector:
    """Cross products along the last axis, shape (…, 3); several times faster than `numpy.cross` for few vectors."""
    return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def skew(v: Vector) -> Vector:
    """The matrix K, shape (3, 3), with `K @ x == cross(v, x)`."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(v: Vector) -> Vector:
    """Matrix, shape (3, 3), of a rotation vector, shape (3,)."""
    angle = float(np.linalg.norm(v))
    k = skew(v)
    # sinc keeps both factors exact down to no rotation at all.
    first, second = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    return np.asarray(np.eye(3) + first * k + second * k @ k)


def log(rotation: Vector) -> Vector:
    """Rotation vector, shape (3,), of a matrix, shape (3, 3); its length is at most pi."""
    r = rotation
    sine = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    length, cosine = float(np.linalg.norm(sine)), (float(np.trace(r)) - 1) / 2
    if length > _NO_SINE:
        return np.asarray(sine * (np.arctan2(length, cosine) / length))
    if cosine > 0:
        return sine
    # Near half a turn the symmetric part, cos I + (1 - cos) a aT, has the axis.
    columns = (r + r.T) / 2 - cosine * np.eye(3)
    axis = columns[:, np.argmax(np.diag(columns))]
    axis = axis / np.linalg.norm(axis) * (-1.0 if axis @ sine < 0 else 1.0)
    return np.asarray(axis * np.arctan2(length, cosine))
