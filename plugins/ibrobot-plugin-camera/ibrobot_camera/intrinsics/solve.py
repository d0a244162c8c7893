"""Intrinsics from views of a board, by Zhang's method as OpenCV has it, and whether they can be relied on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import attrs
import cv2
import numpy as np
import yaml
from ibrobot_provenance.files import replace_file
from ibrobot_terminal.plural import counted
from numpy.typing import NDArray

from ibrobot_camera.intrinsics.views import CELLS, View, by_size
from ibrobot_core.api import SensorError

FEWEST_VIEWS = 10
MOST_RMS_PX = 1.0
LEAST_ANGLE_DEG = 25.0
"""Least angle between the boards of two views."""
LEAST_COVERAGE = 0.6
MOST_UNCERTAINTY = 0.005
"""Greatest standard deviation of the focal lengths, as a share of them."""
_OUTLIER = 3.0
"""A view whose error is this many times the median is an outlier..."""
_OUTLIER_PX = 0.5
"""...if it is also above this [px]."""


@attrs.frozen(eq=False)
class Intrinsics:
    """What a lens does to a picture: a pinhole with the distortion `plumb_bob` of ROS."""

    size: tuple[int, int]
    """Width and height [px]."""
    matrix: NDArray[np.float64]
    """Camera matrix [px], shape (3, 3)."""
    distortion: NDArray[np.float64]
    """k1, k2, p1, p2, k3, shape (5,)."""
    rms: float
    """Reprojection error [px]."""
    errors: dict[str, float]
    """View that was used -> its reprojection error [px]."""
    dropped: dict[str, float]
    """View that was an outlier -> its reprojection error [px]."""
    uncertainty: NDArray[np.float64]
    """Standard deviation of fx, fy, cx, cy [px], shape (4,)."""
    coverage: float
    """Share of the picture's nine parts in which the board was seen."""
    angle_deg: float
    """Greatest angle between the boards of two views [deg]."""

    def lines(self) -> list[str]:
        """The result in a few lines."""
        (fx, _, cx), (_, fy, cy) = self.matrix[:2]
        uncertain = self.uncertainty
        worst = max(self.errors, key=lambda name: self.errors[name])
        lines = [
            f"focal length {fx:.1f} ± {uncertain[0]:.1f}, {fy:.1f} ± {uncertain[1]:.1f} px; "
            f"centre {cx:.1f} ± {uncertain[2]:.1f}, {cy:.1f} ± {uncertain[3]:.1f} px",
            f"distortion {', '.join(f'{value:.4f}' for value in self.distortion)}",
            f"{self.rms:.2f} px reprojection error in {counted(len(self.errors), 'view')}; worst "
            f"{self.errors[worst]:.2f} px ({worst})",
        ]
        lines += [f"left out: {name}, {error:.2f} px" for name, error in self.dropped.items()]
        return lines

    def save(self, path: Path, name: str) -> None:
        """Write them in the format of ROS's camera_calibration, for the option `info` of a camera.

        Raises:
            SensorError: if the file cannot be written.
        """
        fx, cx, fy, cy = self.matrix[0, 0], self.matrix[0, 2], self.matrix[1, 1], self.matrix[1, 2]
        document = {
            "image_width": self.size[0],
            "image_height": self.size[1],
            "camera_name": name,
            "camera_matrix": _matrix(self.matrix),
            "distortion_model": "plumb_bob",
            "distortion_coefficients": _matrix(self.distortion[None]),
            "rectification_matrix": _matrix(np.eye(3)),
            "projection_matrix": _matrix(np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]])),
        }
        comment = "".join(f"# {line}\n" for line in self.lines()[2:3])
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, comment + yaml.safe_dump(document, sort_keys=False, default_flow_style=None))
        except OSError as error:
            raise SensorError(f"{path}: cannot be written: {error.strerror or error}") from None


def _matrix(values: NDArray[np.float64]) -> dict[str, object]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": [float(value) for value in values.ravel()]}


def solve(views: Sequence[View]) -> Intrinsics:
    """The intrinsics; views that fit much worse than the others are left out.

    Raises:
        SensorError: if the views are too few, too similar, of several sizes, or do not fit; says what to do.
    """
    sizes = by_size(views)
    if len(sizes) > 1:
        counts = ", ".join(f"{len(each)} of {w}x{h}" for (w, h), each in sizes.items())
        raise SensorError(f"the pictures differ in size ({counts}): take all with one camera and one setting")
    used, dropped = list(views), dict[str, float]()
    while True:
        if len(used) < FEWEST_VIEWS:
            left_out = f" ({len(dropped)} did not fit and were left out)" if dropped else ""
            raise SensorError(
                f"{counted(len(used), 'view')}{left_out}; at least {FEWEST_VIEWS} are needed, from different sides and "
                "distances"
            )
        result = _solved(used, dropped)
        errors = np.array(list(result.errors.values()))
        outlier = int(errors.argmax())
        if errors[outlier] <= max(_OUTLIER * np.median(errors), _OUTLIER_PX):
            break
        dropped[used.pop(outlier).name] = float(errors[outlier])
    _check(result)
    return result


def _solved(views: Sequence[View], dropped: dict[str, float]) -> Intrinsics:
    size = views[0].size
    points, corners = [view.points for view in views], [view.corners for view in views]
    try:
        rms, matrix, distortion, rotations, _, deviations, _, errors = cv2.calibrateCameraExtended(
            points, corners, size, np.eye(3), np.zeros(5)
        )
    except cv2.error as error:
        raise SensorError(f"the views allow no calibration: {str(error).strip().splitlines()[-1]}") from None
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    angle = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max()))
    covered = {cell for view in views for cell in view.cells}
    names = [view.name for view in views]
    return Intrinsics(
        size, np.array(matrix, np.float64), np.array(distortion, np.float64).ravel()[:5], float(rms),
        dict(zip(names, np.asarray(errors).ravel().tolist(), strict=True)), dict(dropped),
        np.array(deviations, np.float64).ravel()[:4], len(covered) / sum(map(len, CELLS)), angle,
    )  # fmt: skip


def _check(result: Intrinsics) -> None:
    """Raise the reason why the result cannot be relied on."""
    if result.angle_deg < LEAST_ANGLE_DEG:
        raise SensorError(
            f"the board is almost parallel in all views (at most {result.angle_deg:.0f} degrees apart, at least "
            f"{LEAST_ANGLE_DEG:g} are needed): tilt it to all sides"
        )
    if result.coverage < LEAST_COVERAGE:
        raise SensorError(
            f"the board was seen in {result.coverage:.0%} of the picture only: show it in the corners, too"
        )
    if result.rms > MOST_RMS_PX:
        raise SensorError(
            f"the views fit together to {result.rms:.1f} px only, at most {MOST_RMS_PX:g} is usual: is the board flat, "
            "are the pictures sharp, and is the focus the same in all of them?"
        )
    share = float((result.uncertainty[:2] / np.diag(result.matrix)[:2]).max())
    if share > MOST_UNCERTAINTY:
        raise SensorError(
            f"the focal length is known to {share:.1%} only, at most {MOST_UNCERTAINTY:.1%} is usual: take more views, "
            "tilted to all sides and near to the camera"
        )
