"""The board: a chessboard with ArUco markers, which is found even if a part of it is hidden."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import attrs
import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ibrobot_core.api import SensorError, documented, option

PAPERS: Mapping[str, tuple[float, float]] = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "letter": (279.4, 215.9)}
"""Paper -> width and height, landscape [mm]."""
_DICTIONARY = cv2.aruco.DICT_5X5_250
_MARKER = 0.75
"""Side of a marker, as a share of the side of a square."""
_DPI = 300
_EDGE_MM = 8.0
"""What printers leave white at each edge [mm]."""
_MM_PER_INCH = 25.4


@documented
@attrs.frozen(kw_only=True)
class Board:
    """A ChArUco board with markers of 5x5 bits."""

    columns: int = option(10, ge=4, le=20, help="squares from left to right")
    rows: int = option(7, ge=4, le=20, help="squares from top to bottom")
    square: float = option(25.0, gt=1, le=500, unit="mm", help="side of a square, as measured on the print")

    @cached_property
    def pattern(self) -> cv2.aruco.CharucoBoard:
        """As OpenCV has it, in metres."""
        square = self.square / 1000
        dictionary = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), square, _MARKER * square, dictionary)

    @cached_property
    def detector(self) -> cv2.aruco.CharucoDetector:
        """Finds its corners."""
        return cv2.aruco.CharucoDetector(self.pattern)

    def page(self, paper: str) -> NDArray[np.uint8]:
        """A page with the board at true size for 300 dots per inch, shape (H, W).

        Raises:
            SensorError: if the paper is too small.
        """
        width, height = PAPERS[paper]
        needed = self.columns * self.square, self.rows * self.square
        room = width - 2 * _EDGE_MM, height - 2 * _EDGE_MM
        if needed[0] > room[0] or needed[1] > room[1]:
            fitting = min(room[0] / self.columns, room[1] / self.rows)
            raise SensorError(
                f"a board of {needed[0]:g} x {needed[1]:g} mm does not fit on {paper}, which has room for "
                f"{room[0]:g} x {room[1]:g} mm: --square {np.floor(fitting):g} does"
            )
        page = np.full((_dots(height), _dots(width)), 255, np.uint8)
        size = _dots(needed[0]), _dots(needed[1])
        top, left = (page.shape[0] - size[1]) // 2, (page.shape[1] - size[0]) // 2
        page[top : top + size[1], left : left + size[0]] = self.pattern.generateImage(size)
        return page

    def save(self, path: Path, paper: str) -> None:
        """Write the page as PDF or PNG, at true size.

        Raises:
            SensorError: for another ending, a paper that is too small, or a file that cannot be written.
        """
        if path.suffix.lower() not in (".pdf", ".png"):
            raise SensorError(f"{path}: must end in .pdf or .png")
        page = Image.fromarray(self.page(paper))
        try:
            if path.suffix.lower() == ".pdf":
                page.save(path, resolution=_DPI)
            else:
                page.save(path, dpi=(_DPI, _DPI))
        except OSError as error:
            raise SensorError(f"{path}: cannot be written: {error.strerror or error}") from None


def _dots(mm: float) -> int:
    return round(mm / _MM_PER_INCH * _DPI)
