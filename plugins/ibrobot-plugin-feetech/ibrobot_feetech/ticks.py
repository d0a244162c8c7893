"""Servo ticks and radians."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from ibrobot_calibration import JointCalibration
from numpy.typing import NDArray

TICKS_PER_TURN = JointCalibration.TICKS_PER_TURN
"""Encoder positions per turn."""
MIDDLE_TICK = TICKS_PER_TURN // 2
"""Middle of a turn [ticks]."""
TICKS_PER_RADIAN = TICKS_PER_TURN / (2 * math.pi)


def ticks_to_radians(
    ticks: float | NDArray[Any], *, zero: float | NDArray[Any] = MIDDLE_TICK, inverted: bool | NDArray[np.bool_] = False
) -> NDArray[np.float64]:
    """Servo ticks -> radians.

    Args:
        ticks: positions reported by the servo; a number or an array of any shape.
        zero: the tick at which the joint is at 0 rad; a number, or one per joint.
        inverted: whether radians decrease as ticks increase (LeRobot's `drive_mode` 1); likewise.
    """
    radians: NDArray[np.float64] = (ticks - zero) * np.where(inverted, -1.0, 1.0) / TICKS_PER_RADIAN
    return radians


def radians_to_ticks(
    radians: float | NDArray[Any],
    *,
    zero: float | NDArray[Any] = MIDDLE_TICK,
    inverted: bool | NDArray[np.bool_] = False,
) -> NDArray[np.float64]:
    """Radians -> servo ticks, not rounded; the inverse of `ticks_to_radians`."""
    ticks: NDArray[np.float64] = radians * np.where(inverted, -1.0, 1.0) * TICKS_PER_RADIAN + zero
    return ticks
