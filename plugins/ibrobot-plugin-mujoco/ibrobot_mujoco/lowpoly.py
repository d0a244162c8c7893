"""Low-poly meshes for rendering, so that small machines can render several cameras: clusters vertices on a grid."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from ibrobot_kinematics.meshes import cluster
from numpy.typing import NDArray

from ibrobot_core.api import HardwareError

GRID_M = 0.0025
_STL_FACET = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 84


def read_stl(path: Path) -> NDArray[np.float64]:
    """The triangles of a binary STL file [file units], shape (F, 3, 3): face, corner, axis.

    Raises:
        HardwareError: if the file is not a binary STL.
    """
    content = path.read_bytes()
    count = int.from_bytes(content[80:_STL_HEADER], "little")
    if len(content) != _STL_HEADER + count * _STL_FACET.itemsize:
        raise HardwareError(f"{path}: not a binary STL file")
    return np.frombuffer(content, _STL_FACET, count, _STL_HEADER)["vertices"].astype(np.float64)


@lru_cache(maxsize=256)
def low_poly(path: Path, grid: float) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """The clustered vertices and faces of an STL file, cached for further cameras."""
    return cluster(read_stl(path), grid)
