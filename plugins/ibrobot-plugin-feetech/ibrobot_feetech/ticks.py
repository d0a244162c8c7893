"""Servo ticks."""

from __future__ import annotations

import math

from ibrobot_calibration import JointCalibration

TICKS_PER_TURN = JointCalibration.TICKS_PER_TURN
"""Encoder positions per turn."""
MIDDLE_TICK = TICKS_PER_TURN // 2
"""Middle of a turn [ticks]."""
TICKS_PER_RADIAN = TICKS_PER_TURN / (2 * math.pi)
