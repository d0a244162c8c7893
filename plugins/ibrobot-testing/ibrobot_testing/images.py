"""Image messages made of arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Header, Image


def encode_image(array: NDArray[Any], encoding: str, header: Header, *, padding: int = 0) -> Image:
    """An Image message of `array`, little-endian.

    Args:
        array: shape (H, W, C), or (H, W) for one channel, of the encoding's element type.
        encoding: as sensor_msgs names it, e.g. `rgb8`.
        header: stamp and frame.
        padding: bytes after each row.
    """
    height, width = array.shape[:2]
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    rows = little.view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return Image(header, height, width, encoding, rows.shape[1], rows.reshape(-1))
