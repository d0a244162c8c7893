"""Closed forms of the loop `A Y = X B` of a camera, a board and the links that carry them.

A is the pose of the board's link in the camera's link, B the pose of the board in the camera, X that of the camera in
its link, and Y that of the board in its link. All arrays of poses have the shape (N, 4, 4).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import log

from ibrobot_core.api import Vector

type Solver = Callable[[Vector, Vector], tuple[Vector, Vector]]
"""Poses A and B -> rotations of X and Y, shape (3, 3) each."""


def nearest_rotation(matrix: Vector) -> Vector:
    """The rotation that is nearest to a matrix, shape (3, 3)."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v)


def turns(poses: Vector) -> Vector:
    """The rotation vectors from each pose to each later one, seen from where the poses are given, shape (P, 3)."""
    rotations = poses[:, :3, :3]
    first, second = np.triu_indices(len(poses), 1)
    return log(rotations[second] @ rotations[first].mT)


def by_axes(a: Vector, b: Vector) -> tuple[Vector, Vector]:
    """Align the axes of all motions. Source: Park and Martin, Robot sensor calibration (1994)."""
    rotation = nearest_rotation(turns(a).T @ turns(b))
    return rotation, nearest_rotation((a[:, :3, :3].mT @ rotation @ b[:, :3, :3]).sum(axis=0))


def by_kronecker(a: Vector, b: Vector) -> tuple[Vector, Vector]:
    """Solve for both rotations at once. Source: Shah, Solving the robot-world/hand-eye calibration problem (2013)."""
    total = sum(np.kron(second, first) for first, second in zip(a[:, :3, :3], b[:, :3, :3], strict=True))
    u, _, v = np.linalg.svd(total)
    x, y = u[:, 0].reshape(3, 3).T, v[0].reshape(3, 3).T
    sign = np.sign(np.linalg.det(x))
    return nearest_rotation(sign * x), nearest_rotation(sign * y)


SOLVERS: Mapping[str, Solver] = {"Park": by_axes, "Shah": by_kronecker}
"""Name -> solver."""


def solved(a: Vector, b: Vector, solver: Solver) -> tuple[Vector, Vector]:
    """The poses X and Y, shape (4, 4) each: rotations by a solver, and all positions by least squares."""
    rotation_x, rotation_y = solver(a, b)
    count = len(a)
    system = np.concatenate([a[:, :3, :3], np.broadcast_to(-np.eye(3), (count, 3, 3))], axis=2).reshape(-1, 6)
    known = (b[:, :3, 3] @ rotation_x.T - a[:, :3, 3]).reshape(-1)
    places = np.linalg.lstsq(system, known)[0]
    return homogeneous(rotation_x, places[3:]), homogeneous(rotation_y, places[:3])


def scale_of(a: Vector, b: Vector, rotation: Vector) -> tuple[float, float]:
    """By how much the positions of B are to be scaled to fit, and its standard deviation; `rotation` is that of X."""
    count = len(a)
    fixed = np.broadcast_to(-np.eye(3), (count, 3, 3))
    along = -(b[:, :3, 3] @ rotation.T)[:, :, None]
    system = np.concatenate([a[:, :3, :3], fixed, along], axis=2).reshape(-1, 7)
    known = -a[:, :3, 3].reshape(-1)
    solution = np.linalg.lstsq(system, known)[0]
    rest = known - system @ solution
    variance = float(rest @ rest) / max(1, len(known) - 7)
    return float(solution[6]), float(np.sqrt(variance * np.linalg.pinv(system.T @ system)[6, 6]))
