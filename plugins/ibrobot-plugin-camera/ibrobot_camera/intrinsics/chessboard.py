"""Corners of a plain chessboard, without markers: it must be seen whole."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

LEAST_WINDOW, MOST_WINDOW = 2, 11
"""Half sizes of the window in which a corner is located [px].

The window must not reach the next corners, so it depends on the size of the squares in the picture: half of the
distance to the nearest other corner. Below the least one, there are too few pixels; the most is what the calibration
that comes with OpenCV uses by default.
"""
_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
_ENOUGH = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)


def find_corners(grey: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.float32] | None:
    """The inner corners of a chessboard, row by row, shape (N, 2) [px]; None if it is not seen whole.

    A chessboard looks the same from both ends. The first row begins at the left end of the board, in the picture.

    Args:
        grey: shape (H, W).
        size: number of inner corners in a row, and in a column.
    """
    seen, rough = cv2.findChessboardCorners(grey, size, flags=_FLAGS)
    if not seen or rough is None:
        return None
    corners = np.asarray(rough, np.float32).reshape(-1, 2)
    if corners[-1, 0] < corners[0, 0]:
        corners = np.ascontiguousarray(corners[::-1])
    windows = windows_of(corners, size)
    for window in np.unique(windows).tolist():
        chosen = windows == window
        corners[chosen] = cv2.cornerSubPix(
            grey, np.ascontiguousarray(corners[chosen]), (window, window), (-1, -1), _ENOUGH
        )
    return corners


def windows_of(corners: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.int64]:
    """Half size of each corner's window [px], shape (N,)."""
    grid = corners.reshape(size[1], size[0], 2)
    nearest = np.full(grid.shape[:2], np.inf)
    for axis in (0, 1):
        apart = np.linalg.norm(np.diff(grid, axis=axis), axis=2)
        before, after = (slice(None, -1), slice(1, None))
        for at in (before, after):
            part = nearest[(at, slice(None)) if axis == 0 else (slice(None), at)]
            np.minimum(part, apart, out=part)
    return np.clip(nearest.ravel() / 2, LEAST_WINDOW, MOST_WINDOW).astype(np.int64)
