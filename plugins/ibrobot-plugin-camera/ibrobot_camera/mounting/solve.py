"""Where a camera is mounted, and whether that can be relied on."""

from __future__ import annotations

import attrs
import numpy as np
from ibrobot_kinematics.frames import OPTICAL
from ibrobot_kinematics.rotations import from_quaternion, log, rpy
from ibrobot_terminal.plural import counted

from ibrobot_camera.mounting.closed import SOLVERS, solved
from ibrobot_camera.mounting.fit import Fit, Session
from ibrobot_camera.mounting.reasons import check_count, check_turns, explain
from ibrobot_camera.mounting.shots import board_pose
from ibrobot_core.api import SensorError, Vector

MOST_MM, MOST_DEG = 20.0, 6.0
"""Greatest error of cross-validation."""
MOST_UNCERTAIN_MM, MOST_UNCERTAIN_DEG = 8.0, 1.5
"""Greatest standard deviation of the result."""
_PARTS = 5
"""Number of parts of a cross-validation."""


@attrs.frozen(eq=False)
class Mounting:
    """Where a camera is mounted."""

    place: Vector
    """The camera's frame (x ahead, y left, z up) in its link, shape (4, 4)."""
    board: Vector
    """The board in its link, shape (4, 4)."""
    used: tuple[str, ...]
    """The pictures."""
    dropped: dict[str, float]
    """Picture that does not fit -> its error [px]."""
    error_px: float
    """Median distance of the corners from their places."""
    error_mm: float
    """Of cross-validation: how far the board is from where the other pictures predict it, median."""
    error_deg: float
    uncertain_mm: float
    """Standard deviation of the camera's place."""
    uncertain_deg: float
    solvers: dict[str, tuple[float, float]]
    """Solver -> how far its result is from this one [mm, deg]."""

    @property
    def xyz(self) -> tuple[float, ...]:
        """Its position [m], shape (3,)."""
        return tuple(round(float(each), 5) for each in self.place[:3, 3])

    @property
    def rpy(self) -> tuple[float, ...]:
        """Roll, pitch and yaw [rad], shape (3,)."""
        return tuple(round(float(each), 5) for each in rpy(self.place[:3, :3]))

    def lines(self) -> list[str]:
        """The result in a few lines."""
        x, y, z = (1000 * each for each in self.xyz)
        roll, pitch, yaw = np.degrees(self.rpy)
        lines = [
            f"position {x:.1f}, {y:.1f}, {z:.1f} mm ± {self.uncertain_mm:.1f}; roll, pitch, yaw {roll:.2f}, "
            f"{pitch:.2f}, {yaw:.2f} degrees ± {self.uncertain_deg:.2f}",
            f"cross-validation: {self.error_mm:.1f} mm and {self.error_deg:.2f} degrees; {self.error_px:.2f} px in "
            + counted(len(self.used), "picture"),
        ]
        if self.solvers:
            apart = "; ".join(f"{name} {mm:.1f} mm, {deg:.2f} degrees" for name, (mm, deg) in self.solvers.items())
            lines.append(f"solvers differ from it by: {apart}")
        lines += [f"left out: {name}, {error:.1f} px" for name, error in self.dropped.items()]
        return lines


def solve_mount(session: Session, seen: str = "") -> Mounting:
    """Where the camera of a session is mounted; pictures that do not fit are left out, and named.

    Args:
        session: the pictures.
        seen: why other pictures cannot be used, for the message that these are too few.

    Raises:
        SensorError: if they cannot tell it; says why, and what to do.
    """
    measured = session.board is not None
    check_count(len(session.shots), measured=measured, seen=seen)
    check_turns(session)
    fit = session.fit()
    explain(session, fit)
    part = session.some(fit.used)
    left_out = f" ({(~fit.used).sum()} did not fit and were left out)"
    check_count(len(part.shots), measured=measured, seen=left_out)
    check_turns(part)
    error_mm, error_deg, uncertain_mm, uncertain_deg = _checked(part, fit)
    if error_mm > MOST_MM or error_deg > MOST_DEG:
        raise SensorError(
            f"in cross-validation the board is {error_mm:.0f} mm and {error_deg:.1f} degrees from where the other "
            f"pictures predict it; at most {MOST_MM:g} mm and {MOST_DEG:g} degrees are allowed: were camera and board "
            "fixed, did the arm stand still, and are the zeros of the joints and the URDF right?"
        )
    if uncertain_mm > MOST_UNCERTAIN_MM or uncertain_deg > MOST_UNCERTAIN_DEG:
        raise SensorError(
            f"the mount is known only to {uncertain_mm:.0f} mm and {uncertain_deg:.1f} degrees; at most "
            f"{MOST_UNCERTAIN_MM:g} mm and {MOST_UNCERTAIN_DEG:g} degrees are allowed: take more pictures, turned to "
            "all sides and nearer to the board"
        )
    names = [shot.name for shot in session.shots]
    optical = np.eye(4)
    optical[:3, :3] = from_quaternion((OPTICAL.x, OPTICAL.y, OPTICAL.z, OPTICAL.w))
    apart = (
        {}
        if measured
        else {name: _apart(solved(part.arm, part.seen, each)[0], fit.camera) for name, each in SOLVERS.items()}
    )
    return Mounting(
        fit.camera @ optical.T, fit.board, tuple(name for name, each in zip(names, fit.used, strict=True) if each),
        {name: float(error) for name, error, each in zip(names, fit.errors, fit.used, strict=True) if not each},
        float(np.median(fit.errors[fit.used])), error_mm, error_deg, uncertain_mm, uncertain_deg, apart,
    )  # fmt: skip


def _checked(session: Session, fit: Fit) -> tuple[float, float, float, float]:
    """Errors of cross-validation and standard deviations of the result, each in mm and degrees."""
    count = len(session.shots)
    parts = min(_PARTS, count)
    away, results = [], []
    for number in range(parts):
        held = np.arange(count) % parts == number
        camera, board = session.some(~held).estimated((fit.camera, fit.board))
        results.append(camera)
        for shot, arm in zip(np.array(session.shots, object)[held], session.arm[held], strict=True):
            told = np.linalg.inv(camera) @ arm @ board
            measured = board_pose(shot.view, session.lens, told)
            middle = np.append(shot.view.points.mean(axis=0), 1.0)
            apart = (told - measured) @ middle
            turned = np.linalg.norm(log(told[:3, :3] @ measured[:3, :3].T))
            away.append((1000 * float(np.linalg.norm(apart)), float(np.degrees(turned))))
    error_mm, error_deg = np.median(away, axis=0).tolist()
    spread = np.array([_apart(camera, fit.camera) for camera in results])
    # The jackknife's standard deviation, of parts instead of single pictures.
    uncertain_mm, uncertain_deg = np.sqrt((parts - 1) / parts * (spread**2).sum(axis=0)).tolist()
    return error_mm, error_deg, uncertain_mm, uncertain_deg


def _apart(one: Vector, other: Vector) -> tuple[float, float]:
    """Distance [mm] and angle [deg] of two poses."""
    turned = float(np.linalg.norm(log(one[:3, :3] @ other[:3, :3].T)))
    return 1000 * float(np.linalg.norm(one[:3, 3] - other[:3, 3])), float(np.degrees(turned))
