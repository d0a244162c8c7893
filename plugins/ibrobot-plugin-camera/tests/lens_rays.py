"""Directions in which the pixels of a camera look, whose lens bends what it shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def directions(
    lens: NDArray[np.float64], barrel: NDArray[np.float64], size: tuple[int, int], shift: tuple[float, float] = (0, 0)
) -> NDArray[np.float64]:
    """In the frame of the camera, shape (H * W, 3): the inverse of the distortion.

    Args:
        lens: camera matrix [px], shape (3, 3).
        barrel: k1, k2, p1, p2 and an unused one.
        size: width and height [px].
        shift: of the places within their pixels, from the middles [px].
    """
    columns, rows = np.meshgrid(np.arange(float(size[0])) + shift[0], np.arange(float(size[1])) + shift[1])
    bent = np.stack([(columns - lens[0, 2]) / lens[0, 0], (rows - lens[1, 2]) / lens[1, 1]])
    (x, y), (k1, k2, p1, p2, _) = bent, barrel
    for _ in range(40):  # by its fixed point
        square = x * x + y * y
        moved = np.stack([2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y])
        x, y = (bent - moved) / (1 + k1 * square + k2 * square**2)
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
