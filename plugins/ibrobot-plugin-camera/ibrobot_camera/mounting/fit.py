"""The mount that fits most pictures, without those that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import attrs
import numpy as np
from ibrobot_kinematics.link_chain import Chain
from ibrobot_kinematics.rotations import exp
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ibrobot_camera.mounting.closed import SOLVERS, nearest_rotation, solved
from ibrobot_camera.mounting.shots import Lens, Shot
from ibrobot_core.api import Vector

_TRIALS, _SAMPLE = 40, 4
"""Number and size of the samples of pictures, one of which should be free of outliers."""
_OUTLIER = 3.0
"""A picture is an outlier if its error is this many times the median..."""
_LEAST = 2.0 / 640
"""...and at least this, as a share of the picture's width."""
USUAL = 0.7
"""Share of the pictures that tell how well a mount fits: the others may be outliers."""
_ROUNDS = 6
_SOFT = 1.0 / 640
"""Error from which a corner counts less, as a share of the picture's width..."""
_ARM = 1.5
"""Error in relation to the noise of the pictures from which it is the arm's."""
_SOFTER = 2.0
"""...and at least this many times the usual error, which that of the joints may be."""


@attrs.frozen(eq=False)
class Fit:
    """A mount, and how well it fits."""

    camera: Vector
    """The camera's optical frame in its link, shape (4, 4)."""
    board: Vector
    """The board in its link, shape (4, 4)."""
    errors: Vector
    """Median distance of the corners in each picture from their places [px], shape (N,)."""
    used: NDArray[np.bool_]
    """The pictures that are no outliers, shape (N,)."""

    @property
    def typical(self) -> float:
        """The error of seven of ten pictures [px]: at most this."""
        return float(np.quantile(self.errors, USUAL))


class Session:
    """The pictures of a session.

    Args:
        shots: the pictures.
        chain: what moves between camera and board.
        lens: the camera's.
        board: the board in its link, shape (4, 4), if it was measured.
    """

    def __init__(self, shots: Sequence[Shot], chain: Chain, lens: Lens, board: Vector | None = None) -> None:
        self.shots, self.chain, self.lens, self.board = tuple(shots), chain, lens, board
        self.arm = np.array([chain.pose(shot.joints) for shot in shots]).reshape(-1, 4, 4)
        """The board's link in the camera's link, shape (N, 4, 4)."""
        self.seen = np.array([shot.board for shot in shots]).reshape(-1, 4, 4)
        """The board in the camera, shape (N, 4, 4)."""

    def some(self, chosen: NDArray[np.bool_]) -> Session:
        """A part of the pictures."""
        shots = [shot for shot, each in zip(self.shots, chosen, strict=True) if each]
        return Session(shots, self.chain, self.lens, self.board)

    def fit(self) -> Fit:
        """The mount that fits best, by the least median of the errors over samples of the pictures."""
        candidates = [(self.errors(*pair), pair) for pair in self._candidates()]
        errors, pair = min(candidates, key=lambda each: float(np.median(each[0])))
        used = self._fitting(errors)
        for _ in range(_ROUNDS):
            part = self.some(used)
            pair = part.estimated(pair)
            errors = self.errors(*pair)
            before, used = used, self._fitting(errors)
            if (before == used).all():
                break
        return Fit(*pair, errors, used)

    def _fitting(self, errors: Vector) -> NDArray[np.bool_]:
        limit = max(_OUTLIER * float(np.median(errors)), _LEAST * self.lens.size[0])
        return np.asarray(errors <= limit)

    def _candidates(self) -> list[tuple[Vector, Vector]]:
        if self.board is not None:
            return self.closed()
        # Samples are drawn with the same numbers each time, so that the same pictures give the same result.
        draw, count = np.random.default_rng(0), len(self.shots)
        samples = (draw.permutation(count)[:_SAMPLE] for _ in range(_TRIALS))
        solver = SOLVERS["Park"]
        return [*self.closed(), *(solved(self.arm[each], self.seen[each], solver) for each in samples)]

    def closed(self) -> list[tuple[Vector, Vector]]:
        """The mounts by each solver, or, if the board's place was measured, by each picture and all of them."""
        if self.board is None:
            return [solved(self.arm, self.seen, solver) for solver in SOLVERS.values()]
        cameras = self.arm @ self.board @ np.linalg.inv(self.seen)
        middle = np.eye(4)
        middle[:3, :3], middle[:3, 3] = nearest_rotation(cameras[:, :3, :3].sum(axis=0)), cameras[:, :3, 3].mean(axis=0)
        return [(camera, self.board) for camera in islice([middle, *cameras], _TRIALS)]

    def errors(self, camera: Vector, board: Vector) -> Vector:
        """Median distance of the corners in each picture from their places [px], shape (N,)."""
        return np.array([np.median(np.hypot(*each.T)) for each in self._distances(camera, board)])

    def _distances(self, camera: Vector, board: Vector) -> list[Vector]:
        """Of the corners in each picture from their places [px], shapes (M, 2)."""
        poses = np.linalg.inv(camera) @ self.arm @ board
        return [
            self.lens.pixels(shot.view.points.astype(np.float64), pose) - shot.view.corners
            for shot, pose in zip(self.shots, poses, strict=True)
        ]

    def estimated(self, start: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
        """The mount that fits all pictures, from one that nearly does.

        If the corners are nearly where each picture has them by itself, their noise is what counts, and their distances
        are the best measure. If they are farther away, the arm is elsewhere than its joints say. Then a turn and a way
        of the camera look alike in a picture, and the closed form, which separates them, is nearer to the truth.
        """
        closed = self.closed()
        starts = [start, *closed]
        pair = self.refined(*min(starts, key=lambda each: float(self.errors(*each).mean())))
        noise = float(np.median([shot.noise for shot in self.shots]))
        return pair if float(np.median(self.errors(*pair))) < _ARM * noise else closed[0]

    def refined(self, camera: Vector, board: Vector) -> tuple[Vector, Vector]:
        """The mount with the least distance of all corners from their places; far ones count less."""

        def moved(step: Vector) -> tuple[Vector, Vector]:
            other = board if self.board is not None else _moved(board, step[6:])
            return _moved(camera, step[:6]), other

        def distances(step: Vector) -> Vector:
            return np.concatenate(self._distances(*moved(step))).ravel()

        free = np.zeros(6 if self.board is not None else 12)
        soft = max(_SOFT * self.lens.size[0], _SOFTER * float(np.median(self.errors(camera, board))))
        best = least_squares(
            distances,
            free,
            loss="soft_l1",
            f_scale=soft,
            x_scale="jac",
            tr_solver="lsmr",
            ftol=1e-5,
            xtol=1e-6,
            max_nfev=20,
        )
        return moved(np.asarray(best.x))


def _moved(pose: Vector, step: Vector) -> Vector:
    """A pose turned and moved by a step in its parent: rotation vector [rad] and way [m], shape (6,)."""
    result = pose.copy()
    result[:3, :3] = exp(step[:3]) @ pose[:3, :3]
    result[:3, 3] += step[3:]
    return result
