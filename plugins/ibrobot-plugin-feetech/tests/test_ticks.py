"""Servo ticks and radians of an arm."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.arm import Arm

JOINTS = ("pan", "lift", "grip")


def arm(*, inverted: tuple[int, ...] = (0, 0, 0), zero_at: str = "pose", closed: float | None = None) -> Arm:
    """Joints whose calibrated ranges are 1000 to 3000 ticks."""
    joints = {
        name: JointCalibration(number, mode, 0, 1000, 3000, zero_at)
        for number, (name, mode) in enumerate(zip(JOINTS, inverted, strict=True), 1)
    }
    return Arm(JOINTS, Calibration(joints), {} if closed is None else {"grip": closed})


def test_the_middle_tick_is_zero_and_a_quarter_turn_is_half_pi() -> None:
    found = arm(inverted=(0, 0, 1)).radians(np.array([2048.0, 3072.0, 3072.0]))
    np.testing.assert_allclose(found, [0.0, math.pi / 2, -math.pi / 2])


def test_zero_is_the_middle_of_the_range_or_where_the_joint_is_anchored() -> None:
    found = arm(zero_at="range", closed=-0.1).radians(np.array([2000.0, 3024.0, 1000.0]))
    np.testing.assert_allclose(found, [0.0, math.pi / 2, -0.1])


def test_goals_stay_within_the_calibrated_ranges() -> None:
    far = np.array([3.0, -3.0, 0.0])
    assert arm().ticks(far).tolist() == [3000, 1000, 2048]
    assert arm().positions(far).tolist() == [
        round(2048 + 3.0 * 2048 / math.pi),
        round(2048 - 3.0 * 2048 / math.pi),
        2048,
    ]


@given(st.floats(-3, 3), st.booleans(), st.sampled_from(["pose", "range"]))
def test_radians_come_back(radians: float, inverted: bool, zero_at: str) -> None:
    servos = arm(inverted=(int(inverted),) * 3, zero_at=zero_at)
    back = servos.radians(servos.positions(np.full(3, radians)).astype(np.float64))
    assert back == pytest.approx(radians, abs=math.pi / 4096 + 1e-9)
