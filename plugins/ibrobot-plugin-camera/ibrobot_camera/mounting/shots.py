"""Pictures of the board with the readings of the joints, and the lens through which they were taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import cv2
import numpy as np
from ibrobot_kinematics.poses import homogeneous
from numpy.typing import NDArray

from ibrobot_camera.intrinsics.views import FEWEST_CORNERS, View
from ibrobot_core.api import CameraInfo, SensorError, Vector

_NOISE = 3.0 / 640
"""Distance from its place on a flat board, from which a corner is left out, as a share of the picture's width."""
_FAR = 1e6
"""Error of a board that is not before the camera [px]."""


@attrs.frozen(eq=False)
class Lens:
    """The intrinsics of a camera."""

    size: tuple[int, int]
    """Width and height [px]."""
    matrix: Vector
    """Camera matrix [px], shape (3, 3)."""
    distortion: Vector
    """k1, k2, p1, p2, k3 of `plumb_bob`, shape (5,)."""

    @classmethod
    def of(cls, info: CameraInfo) -> Lens:
        """The lens of a calibration.

        Raises:
            SensorError: if it has no focal length, or another model of distortion.
        """
        if info.distortion_model != "plumb_bob":
            raise SensorError(f"distortion model {info.distortion_model} is not supported; plumb_bob is")
        if len(info.d) > 5:
            raise SensorError(f"the calibration has {len(info.d)} numbers of distortion, plumb_bob has at most 5")
        matrix = info.k.reshape(3, 3)
        if not np.isfinite([*info.k, *info.d]).all() or not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise SensorError("the calibration has no finite focal lengths; `ibrobot camera calibrate` measures them")
        distortion = np.zeros(5)
        distortion[: len(info.d)] = info.d
        return cls((info.width, info.height), matrix.copy(), distortion)

    def pixels(self, points: Vector, pose: Vector) -> Vector:
        """Where points are seen.

        Args:
            points: in a frame [m], shape (N, 3).
            pose: that frame in the camera's optical frame, shape (4, 4).

        Returns:
            Pixels, shape (N, 2); far away from any picture for a frame that is not wholly before the camera.
        """
        if (points @ pose[2, :3] + pose[2, 3]).min() <= 1e-3:
            return np.full((len(points), 2), _FAR)
        turn, _ = cv2.Rodrigues(pose[:3, :3])
        seen, _ = cv2.projectPoints(points, turn, pose[:3, 3].copy(), self.matrix, self.distortion)
        return np.asarray(seen, np.float64).reshape(-1, 2)


@attrs.frozen(eq=False)
class Shot:
    """A picture of the board with the readings of the joints."""

    view: View
    joints: Vector
    """Positions of all joints [rad or m], shape (J,)."""
    board: Vector
    """The board in the camera's optical frame, shape (4, 4), from the picture alone."""
    noise: float
    """Median distance of the corners from where this pose has them [px]."""

    @property
    def name(self) -> str:
        """The picture, for messages."""
        return self.view.name


def shot_of(view: View, joints: Vector, lens: Lens) -> Shot | None:
    """A shot of a view; None if too few corners lie on a flat board. Corners that do not are left out."""
    if view.size != lens.size:
        raise SensorError(
            f"{view.name}: the picture has {view.size[0]}x{view.size[1]} pixels, the calibration is for "
            f"{lens.size[0]}x{lens.size[1]}: calibrate the camera in the size in which it is used"
        )
    straight = cv2.undistortPoints(view.corners[:, None], lens.matrix, lens.distortion, P=lens.matrix)
    flat = np.ascontiguousarray(view.points[:, :2])
    _, fits = cv2.findHomography(flat, np.asarray(straight).reshape(-1, 2), cv2.RANSAC, _NOISE * view.size[0])
    if fits is None:
        return None
    kept = np.asarray(fits).ravel() > 0
    if kept.sum() < FEWEST_CORNERS:
        return None
    view = attrs.evolve(view, ids=view.ids[kept], corners=view.corners[kept], points=view.points[kept])
    pose = board_pose(view, lens)
    away = lens.pixels(view.points.astype(np.float64), pose) - view.corners
    return Shot(view, np.asarray(joints, np.float64), pose, float(np.median(np.hypot(*away.T))))


def board_pose(view: View, lens: Lens, guess: Vector | None = None) -> Vector:
    """The board in the camera's optical frame, shape (4, 4); near a guess, if there is one.

    Without one it may be the mirrored pose of a small board that is seen from straight ahead.
    """
    points, corners = view.points.astype(np.float64), view.corners.astype(np.float64)
    if guess is None:
        _, turn, place = cv2.solvePnP(points, corners, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE)
    else:
        turn, place = cv2.Rodrigues(guess[:3, :3])[0], guess[:3, 3].reshape(3, 1).copy()
    turn, place = cv2.solvePnPRefineLM(points, corners, lens.matrix, lens.distortion, turn, place)
    return homogeneous(np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(place, np.float64).ravel())


def scaled(shots: Sequence[Shot], factor: float) -> list[Shot]:
    """The shots as if the board were larger by a factor."""

    def one(shot: Shot) -> Shot:
        board = shot.board.copy()
        board[:3, 3] *= factor
        points = (shot.view.points * factor).astype(np.float32)
        return attrs.evolve(shot, board=board, view=attrs.evolve(shot.view, points=points))

    return [one(shot) for shot in shots]


def with_joints(shots: Sequence[Shot], changed: Mapping[int, NDArray[np.float64]]) -> list[Shot]:
    """The shots with other readings: place of a joint -> its positions in all shots [rad or m], shape (N,)."""
    joints = np.array([shot.joints for shot in shots])
    for column, values in changed.items():
        joints[:, column] = values
    return [attrs.evolve(shot, joints=row) for shot, row in zip(shots, joints, strict=True)]
