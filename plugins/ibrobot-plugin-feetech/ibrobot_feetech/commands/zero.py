"""Describes where the joints of a calibration are at 0 rad."""

from __future__ import annotations

from ibrobot_calibration import Calibration

from ibrobot_feetech.calibration import ZERO_AT
from ibrobot_feetech.ticks import MIDDLE_TICK, TICKS_PER_TURN


def zero_text(calibration: Calibration) -> str:
    """A description of 0 rad, and its distance from the other convention."""
    off = {
        name: abs(joint.range_middle - MIDDLE_TICK) * 360 / TICKS_PER_TURN for name, joint in calibration.joints.items()
    }
    joint = max(off, key=off.__getitem__)
    other = (
        "the pose that was set by hand" if calibration.zero_at == "range" else "LeRobot's 0, the middle of the range,"
    )
    return f"0 rad is {ZERO_AT[calibration.zero_at]}; {other} is up to {off[joint]:.1f} deg from it ({joint})"
