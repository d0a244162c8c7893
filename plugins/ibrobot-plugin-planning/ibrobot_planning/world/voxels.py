"""Voxels from point clouds and depth images."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ibrobot_core.api import PointCloud2, Vector
from ibrobot_planning.world.bounds import FURTHEST
from ibrobot_planning.world.objects import Voxels

MOST_POINTS = 10_000_000
"""Points of a cloud, or pixels of an image, beyond this are refused."""
_SCALES = (0.1, 20.0)
"""Least and greatest plausible focal length, as a share of the width of the image."""
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


def check_intrinsics(intrinsics: Vector, height: int, width: int) -> None:
    """Check that a camera matrix fits images of a size [px]; another one would move or hide what they show.

    Args:
        intrinsics: camera matrix K as in sensor_msgs/msg/CameraInfo, shape (3, 3).
        height: of the images.
        width: of the images.

    Raises:
        ValueError: if a focal length is implausible, or the optical axis is far from the image.
    """
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    least, most = (scale * width for scale in _SCALES)
    if not (least <= fx <= most and least <= fy <= most):  # so that NaN fails it, as below
        raise ValueError(
            f"the focal lengths of its CameraInfo are {fx:g} and {fy:g} pixels;"
            f" for {width} pixels across they are from {least:g} to {most:g}"
        )
    if not (abs(cx - width / 2) <= width and abs(cy - height / 2) <= height):
        raise ValueError(
            f"the optical axis of its CameraInfo is at {cx:g}, {cy:g}, far outside {width}x{height} pixels"
        )


def is_measured(points: Vector) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which points of a sensor are measurements, shape (N,): not those that are not finite, zero, or beyond 1 km.

    Args:
        points: [m] in the frame of the sensor, shape (N, 3).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(points, axis=1)
    return np.asarray((distance > 0) & (distance <= FURTHEST))


def is_depth(depth: np.ndarray[tuple[int, ...], Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which pixels of a depth image [m or, as whole numbers, mm] are measurements: those that are finite and above 0.

    The largest whole number counts as missing, too: some drivers write it for unseen pixels.
    """
    if np.issubdtype(depth.dtype, np.integer):
        return np.asarray((depth > 0) & (depth < np.iinfo(depth.dtype).max))
    return np.asarray(np.isfinite(depth) & (depth > 0))


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
    if message.height * message.width > MOST_POINTS:
        raise ValueError(f"the cloud has {message.height}x{message.width} points, at most {MOST_POINTS} are read")
    if min(message.height, message.width) < 0 or message.point_step < 1:
        raise ValueError(
            f"the cloud has {message.height}x{message.width} points of {message.point_step} bytes each, which is none"
        )
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
        if not 0 <= field.offset <= message.point_step - kind.itemsize:
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
