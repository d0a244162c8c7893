"""Voxels from point clouds and depth images."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ibrobot_core.api import PointCloud2, Vector
from ibrobot_planning.world.objects import Voxels

_FLOATS = {7: np.float32, 8: np.float64}
"""Datatype of sensor_msgs/msg/PointField -> type of its values."""


def voxels(points: Vector, size: float, *, least_points: int = 1) -> Voxels | None:
    """The cells that contain points.

    Args:
        points: [m] in the frame of the voxels, shape (N, 3); rows that are not finite count as missing.
        size: edge of a cell [m].
        least_points: how many points make a cell occupied; more than 1 drops single outliers.

    Returns:
        None if no cell is occupied.
    """
    points = points[np.isfinite(points).all(axis=1)]
    cells, counts = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_counts=True)
    cells = cells[counts >= least_points]
    return Voxels(size, cells) if len(cells) else None


def depth_points(depth: Vector, intrinsics: Vector, furthest: float) -> Vector:
    """The points of a depth image in the optical frame of its camera (z forward, x right, y down, REP 103).

    Args:
        depth: distance along the optical axis of each pixel [m], shape (H, W); 0 and values that are not finite count
            as missing.
        intrinsics: camera matrix K as in sensor_msgs/msg/CameraInfo, shape (3, 3).
        furthest: pixels beyond this [m] are ignored.

    Returns:
        [m], shape (N, 3).

    Raises:
        ValueError: for focal lengths that are not above 0.
    """
    if not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0):
        raise ValueError("intrinsics must be a 3x3 camera matrix with focal lengths above 0")
    row, column = np.nonzero(np.isfinite(depth) & (depth > 0) & (depth <= furthest))
    z = depth[row, column]
    x = (column - intrinsics[0, 2]) / intrinsics[0, 0] * z
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1] * z
    return np.stack([x, y, z], axis=1)


def cloud_points(message: PointCloud2) -> Vector:
    """The points of a point cloud, in its frame.

    Returns:
        [m], shape (N, 3).

    Raises:
        ValueError: for a cloud without x, y and z as floats, or with too few bytes for its size.
    """
    fields = {field.name: field for field in message.fields}
    needed = message.width * message.point_step
    if message.row_step < needed or message.data.size < message.height * message.row_step:
        raise ValueError(
            f"a cloud of {message.height}x{message.width} points of {message.point_step} bytes needs rows of at least"
            f" {needed} bytes; this one has rows of {message.row_step} and {message.data.size} bytes"
        )
    rows = message.data[: message.height * message.row_step].reshape(message.height, message.row_step)
    points = rows[:, :needed].reshape(-1, message.point_step)
    columns = []
    for axis in "xyz":
        if axis not in fields:
            raise ValueError(f"the cloud has no field {axis}; it has: {', '.join(fields) or 'none'}")
        field = fields[axis]
        if field.datatype not in _FLOATS:
            raise ValueError(f"field {axis} of the cloud has datatype {field.datatype}, must be FLOAT32 or FLOAT64")
        kind = np.dtype(_FLOATS[field.datatype]).newbyteorder(">" if message.is_bigendian else "<")
        if field.offset + kind.itemsize > message.point_step:
            raise ValueError(f"field {axis} of the cloud ends beyond its points of {message.point_step} bytes")
        values = np.ascontiguousarray(points[:, field.offset : field.offset + kind.itemsize]).view(kind)
        columns.append(values[:, 0].astype(float))
    return np.stack(columns, axis=1)


def outside(cells: Voxels, shapes: Iterable[tuple[Any, Vector]], margin: float) -> Voxels | None:
    """The cells whose centres are further than `margin` and half a cell from all shapes; None without any.

    Args:
        cells: the cells.
        shapes: shapes of Coal, each with its pose in the frame of the cells, shape (4, 4).
        margin: [m].
    """
    import coal

    reach = margin + cells.size / 2
    ball, nowhere = coal.Sphere(reach), coal.Transform3s()
    centres = cells.centres
    kept = np.ones(len(centres), dtype=bool)
    for shape, placed in shapes:
        local = (centres - placed[:3, 3]) @ placed[:3, :3]
        shape.computeLocalAABB()
        box = shape.aabb_local
        # Only cells near the bounding box are checked against the shape itself; the box of a half space is unbounded.
        near = kept & (local > box.min_ - reach).all(axis=1) & (local < box.max_ + reach).all(axis=1)
        for number in np.flatnonzero(near):
            there = coal.Transform3s(np.eye(3), local[number])
            kept[number] = not coal.collide(
                shape, nowhere, ball, there, coal.CollisionRequest(), coal.CollisionResult()
            )
    return Voxels(cells.size, cells.cells[kept]) if kept.any() else None
