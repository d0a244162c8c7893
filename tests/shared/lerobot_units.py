"""What LeRobot makes of the ticks of a servo, by its own formulas, and the angles of those ticks."""

from __future__ import annotations

import math

from ibrobot_calibration import JointCalibration


def normalised(ticks: float, mode: str, joint: JointCalibration) -> float:
    """Ticks -> LeRobot's unit `mode`, as `MotorsBus._normalize` of LeRobot 0.6."""
    low, high = joint.range_min, joint.range_max
    if mode == "degrees":
        return (ticks - (low + high) / 2) * 360 / 4095
    part = (min(max(ticks, low), high) - low) / (high - low)
    if mode == "range_m100_100":
        return (part * 200 - 100) * (-1 if joint.drive_mode else 1)
    return 100 - part * 100 if joint.drive_mode else part * 100


def angle(ticks: float, joint: JointCalibration, lower: float | None = None) -> float:
    """Ticks -> radians."""
    return (ticks - joint.zero(lower)) * 2 * math.pi / 4096 * (-1 if joint.drive_mode else 1)
