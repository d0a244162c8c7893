"""Rotations as matrices and as rotation vectors: the axis times the angle [rad]."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Vector

_NO_SINE = 1e-6
"""Sine of the angle below which the antisymmetric part of a matrix does not determine the axis."""

_AFTER, _BEFORE = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: Vector, b: Vector) -> Vector:
    """Cross products along the last axis, shape (…, 3); several times faster than `numpy.cross` for few vectors."""
    return a.take(_AFTER, -1) * b.take(_BEFORE, -1) - a.take(_BEFORE, -1) * b.take(_AFTER, -1)


def skew(v: Vector) -> Vector:
    """The matrix K, shape (3, 3), with `K @ x == cross(v, x)`."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(v: Vector) -> Vector:
    """Matrix, shape (3, 3), of a rotation vector, shape (3,)."""
    angle = float(np.linalg.norm(v))
    k = skew(v)
    # sinc keeps both factors exact for small angles, including zero.
    first, second = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    return np.asarray(np.eye(3) + first * k + second * k @ k)


def quaternion(rotation: Vector) -> Vector:
    """Unit quaternion (x, y, z, w), shape (4,), of a matrix, shape (3, 3); w is not negative."""
    turn = log(rotation)
    half = float(np.linalg.norm(turn)) / 2
    return np.append(np.sinc(half / np.pi) / 2 * turn, np.cos(half))


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
