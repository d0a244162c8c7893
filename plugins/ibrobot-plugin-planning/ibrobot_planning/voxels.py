"""Voxels from point clouds and depth images."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Pose, Vector
from ibrobot_planning.transforms import matrix
from ibrobot_planning.world import Voxels


def voxels(points: Vector, size: float, *, least_points: int = 1) -> Voxels | None:
    """The cells that contain points.

    Args:
        points: [m] in the frame of the voxels, shape (N, 3); rows that are not finite count as missing.
        size: edge of a cell [m].
        least_points: how many points make a cell occupied; more than 1 drops single outliers.

    Returns:
        None where no cell is occupied.

    Raises:
        ValueError: for points of another shape, or a size or number that is not above 0.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have shape {points.shape}, must be (N, 3)")
    if not size > 0:
        raise ValueError(f"size is {size} m, must be above 0")
    if least_points < 1:
        raise ValueError(f"least_points is {least_points}, must be at least 1")
    points = points[np.isfinite(points).all(axis=1)]
    cells, counts = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_counts=True)
    cells = cells[counts >= least_points]
    return Voxels(size, cells) if len(cells) else None


def depth_points(depth: Vector, intrinsics: Vector, camera: Pose, *, furthest: float = 2.0) -> Vector:
    """The points of a depth image.

    Args:
        depth: distance along the optical axis of each pixel [m], shape (H, W); 0 and values that are not finite count
            as missing.
        intrinsics: camera matrix K as in sensor_msgs/msg/CameraInfo, shape (3, 3).
        camera: pose of the optical frame (z forward, x right, y down, REP 103) in the frame of the points.
        furthest: pixels beyond this [m] are left out.

    Returns:
        [m], shape (N, 3).

    Raises:
        ValueError: for arrays of other shapes, or focal lengths that are not above 0.
    """
    depth, intrinsics = np.asarray(depth, dtype=float), np.asarray(intrinsics, dtype=float)
    if depth.ndim != 2:
        raise ValueError(f"depth has shape {depth.shape}, must be (H, W)")
    if intrinsics.shape != (3, 3) or not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0):
        raise ValueError("intrinsics must be a 3x3 camera matrix with focal lengths above 0")
    row, column = np.nonzero(np.isfinite(depth) & (depth > 0) & (depth <= furthest))
    z = depth[row, column]
    x = (column - intrinsics[0, 2]) / intrinsics[0, 0] * z
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1] * z
    placed = matrix(camera)
    return np.asarray(np.stack([x, y, z], axis=1) @ placed[:3, :3].T + placed[:3, 3])
