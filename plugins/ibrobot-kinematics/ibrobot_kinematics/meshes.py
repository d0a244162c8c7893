"""Low-poly meshes, for rendering on small machines and in browsers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def cluster(triangles: NDArray[np.float64], grid: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Replace all corners within a cell of `grid` by their mean; removes degenerate and duplicate triangles.

    Args:
        triangles: shape (F, 3, 3): face, corner, axis.
        grid: edge of a cell, in the triangles' unit.

    Returns:
        Vertices, shape (V, 3), and faces as indices into them, shape (G, 3) with G <= F.
    """
    corners = triangles.reshape(-1, 3)
    cells = np.floor(corners / grid).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, index, counts = np.unique(keys, return_inverse=True, return_counts=True)
    vertices = np.stack([np.bincount(index, corners[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    faces = index.reshape(-1, 3)
    first, second, third = faces.T
    faces = faces[(first != second) & (second != third) & (third != first)]
    # Equal triangles may start at different corners; roll the smallest index to the front to compare them.
    start = faces.argmin(axis=1)[:, None]
    faces = np.unique(np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1), axis=0)
    return vertices, faces.astype(np.int32)
