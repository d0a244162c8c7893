"""Views of the board: which pictures tell something new, and what is still missing."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import cv2
import numpy as np
from numpy.typing import NDArray

from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.intrinsics.chessboard import find_corners

FEWEST_CORNERS = 12
CELLS = (("upper left", "top", "upper right"), ("left", "middle", "right"), ("lower left", "bottom", "lower right"))
"""Parts of the picture, by row and column."""
_NEW = 0.12
"""Distance of a view's place from those of all others, from which on it is new."""
_TILT = 0.12
"""Perspective of a board that counts as tilted; about 15 degrees at a common lens."""
_NEAR, _FAR = 0.6, 0.4
"""Share of the picture's width that a near board fills at least, and a far one at most."""
_NOTHING = np.zeros((0, 2), np.float32), np.zeros(0, np.int32)
_STILL = 0.002
"""Greatest motion between two pictures of a board that is held still, as a share of the picture's width."""


@attrs.frozen(eq=False)
class View:
    """The board in one picture."""

    name: str
    """The picture, for messages."""
    size: tuple[int, int]
    """Width and height of the picture [px]."""
    ids: NDArray[np.int32]
    """Numbers of the corners, shape (N,)."""
    corners: NDArray[np.float32]
    """Where they are in the picture [px], shape (N, 2)."""
    points: NDArray[np.float32]
    """Where they are on the board [m], shape (N, 3)."""
    place: NDArray[np.float64]
    """Centre (2), size and tilt (2) of the whole board in the picture, each of the order of 1."""

    @property
    def cells(self) -> set[str]:
        """The parts of the picture with corners of the board."""
        width, height = self.size
        columns = np.clip((self.corners[:, 0] / width * 3).astype(int), 0, 2).tolist()
        rows = np.clip((self.corners[:, 1] / height * 3).astype(int), 0, 2).tolist()
        return {CELLS[row][column] for row, column in zip(rows, columns, strict=True)}


def find(picture: NDArray[np.uint8], board: Board, name: str = "", *, markers: bool = True) -> View | None:
    """The board in a picture, grey or BGR; None if too little of it is seen.

    Without `markers`, it is a plain chessboard with as many squares, and all of it must be seen.
    """
    grey = np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    corners, ids = _marked(grey, board) if markers else _plain(grey, board)
    if len(ids) < FEWEST_CORNERS:
        return None
    points = np.asarray(board.pattern.getChessboardCorners(), np.float32).reshape(-1, 3)[ids]
    if min(len(np.unique(points[:, 0])), len(np.unique(points[:, 1]))) < 3:
        return None  # a strip of the board says nothing about its tilt
    height, width = grey.shape[:2]
    place = _place(corners, points, board, (width, height))
    return None if place is None else View(name, (width, height), ids, corners, points, place)


def _marked(grey: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    corners, ids, _, _ = board.detector.detectBoard(grey)
    if ids is None:
        return _NOTHING
    # OpenCV 4 gives them as (N, 1, 2) and (N, 1), OpenCV 5 as (N, 2) and (N,).
    return np.asarray(corners, np.float32).reshape(-1, 2), np.asarray(ids, np.int32).reshape(-1)


def _plain(grey: NDArray[np.uint8], board: Board) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    corners = find_corners(grey, (board.columns - 1, board.rows - 1))
    return _NOTHING if corners is None else (corners, np.arange(len(corners), dtype=np.int32))


def _place(
    corners: NDArray[np.float32], points: NDArray[np.float32], board: Board, size: tuple[int, int]
) -> NDArray[np.float64] | None:
    """Centre, size and tilt of the whole board from the homography of what is seen of it, shape (5,)."""
    whole = np.array([board.columns, board.rows]) * board.square / 1000
    unit = points[:, :2] / whole - 0.5  # the board from -0.5 to 0.5
    homography, _ = cv2.findHomography(unit.astype(np.float32), corners / size[0])
    if homography is None or abs(homography[2, 2]) < 1e-9:
        return None
    homography = homography / homography[2, 2]
    edges = cv2.perspectiveTransform(np.array([[(-0.5, 0.0), (0.5, 0.0)]], np.float32), homography)[0]
    centre = homography[:2, 2] - 0.5 * np.array([1.0, size[1] / size[0]])
    place: NDArray[np.float64] = np.array([*centre, np.linalg.norm(edges[1] - edges[0]), *homography[2, :2]])
    return place


@attrs.define
class Views:
    """The views collected so far; one that resembles another is not taken."""

    views: list[View] = attrs.field(factory=list)
    _last: View | None = attrs.field(default=None, init=False)

    def add(self, view: View) -> bool:
        """Take a view if it tells something new; returns whether it does."""
        if any(np.linalg.norm(view.place - other.place) < _NEW for other in self.views):
            return False
        self.views.append(view)
        return True

    def add_live(self, view: View | None) -> bool:
        """As `add`, for pictures of a camera that follow one another: only while the board is held still."""
        last, self._last = self._last, view
        if view is None or last is None:
            return False
        _, mine, others = np.intersect1d(view.ids, last.ids, return_indices=True)
        if len(mine) < FEWEST_CORNERS:
            return False
        moved = np.linalg.norm(view.corners[mine] - last.corners[others], axis=1).max()
        return bool(moved <= _STILL * view.size[0]) and self.add(view)

    def missing(self, count: int) -> str:
        """What to do next with the board, in words; empty once there is enough for `count` views."""
        places = np.array([view.place for view in self.views]).reshape(-1, 5)
        covered = {cell for view in self.views for cell in view.cells}
        for cell in (cell for row in CELLS for cell in row):
            if cell not in covered:
                return "show the board in the middle" if cell == "middle" else f"move the board to the {cell}"
        for name, column, sign in (("left", 3, -1), ("right", 3, 1), ("upper", 4, -1), ("lower", 4, 1)):
            if not (sign * places[:, column] > _TILT).any():
                return f"tilt the board: its {name} edge away from the camera"
        if places[:, 2].max() < _NEAR:
            return "nearer: the board should fill most of the picture"
        if places[:, 2].min() > _FAR:
            return "farther away: the board should fill a third of the picture"
        return "a few more views, from elsewhere" if len(self.views) < count else ""


def by_size(views: Sequence[View]) -> dict[tuple[int, int], list[View]]:
    """The views of each size of picture."""
    sizes: dict[tuple[int, int], list[View]] = {}
    for view in views:
        sizes.setdefault(view.size, []).append(view)
    return sizes
