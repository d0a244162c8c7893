"""Radians and LeRobot's units: literal numbers of LeRobot 0.6, its formulas in ticks, and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_calibration import ZERO_AT, JointCalibration
from ibrobot_calibration.joint_units import LEROBOT_MODES, lerobot_to_radians, radians_to_lerobot
from lerobot_units import angle, normalised

modes = st.sampled_from(LEROBOT_MODES)
joints = st.builds(
    lambda drive_mode, ends, zero_at: JointCalibration(1, drive_mode, 0, min(ends), max(ends), zero_at),
    st.integers(0, 1),
    st.sets(st.integers(0, 4095), min_size=2, max_size=2),
    st.sampled_from(ZERO_AT),
)


@pytest.mark.parametrize(
    ("mode", "inverted", "expected"),
    [
        ("range_m100_100", False, -50.0),
        ("range_m100_100", True, 50.0),
        ("range_0_100", False, 25.0),
        ("range_0_100", True, 75.0),
        ("degrees", False, -43.956043956043956),
        ("degrees", True, -43.956043956043956),
    ],
)
def test_numbers_that_lerobot_gives(mode: str, inverted: bool, expected: float) -> None:
    joint = JointCalibration(1, int(inverted), 0, 1000, 3000)
    assert radians_to_lerobot(angle(1500, joint), mode, *joint.ends(), inverted) == pytest.approx(expected, abs=1e-9)
    assert normalised(1500, mode, joint) == expected


@given(modes, joints, st.integers(0, 4095))
def test_angles_become_what_lerobot_makes_of_their_ticks(mode: str, joint: JointCalibration, ticks: int) -> None:
    value = radians_to_lerobot(angle(ticks, joint), mode, *joint.ends(), joint.inverted)
    assert value == pytest.approx(normalised(ticks, mode, joint), abs=1e-7)


@given(modes, joints, st.floats(0, 1))
def test_angles_within_the_range_come_back(mode: str, joint: JointCalibration, part: float) -> None:
    lower, upper = joint.ends()
    angle = lower + part * (upper - lower)
    value = radians_to_lerobot(angle, mode, lower, upper, joint.inverted)
    assert lerobot_to_radians(value, mode, lower, upper, joint.inverted) == pytest.approx(angle, abs=1e-9)


def test_arrays_are_converted_element_by_element() -> None:
    lower, upper = np.array([-1.0, 0.0]), np.array([1.0, 2.0])
    inverted = np.array([False, True])
    values = radians_to_lerobot(np.array([[0.5, 0.5], [9.0, -9.0]]), "range_0_100", lower, upper, inverted)
    np.testing.assert_allclose(values, [[75, 25], [100, 0]])
    found = lerobot_to_radians(values, "range_0_100", lower, upper, inverted)
    np.testing.assert_allclose(found, [[0.5, 0.5], [1.0, 0.0]])
    degrees = radians_to_lerobot(np.array([math.pi / 2, math.pi / 2]), "degrees", -1.0, 1.0, inverted)
    np.testing.assert_allclose(degrees, np.array([90, -90]) * 4096 / 4095)


def test_ranges_clip_and_degrees_do_not() -> None:
    assert radians_to_lerobot(5.0, "range_m100_100", -1.0, 1.0, False) == 100
    assert radians_to_lerobot(5.0, "degrees", -1.0, 1.0, False) > 200
    assert lerobot_to_radians(150.0, "range_0_100", -1.0, 1.0, False) == 1.0


@pytest.mark.parametrize("drive_mode", [0, 1])
def test_anchored_joint_is_at_its_lower_limit_where_it_is_closed(drive_mode: int) -> None:
    joint = JointCalibration(1, drive_mode, 0, 700, 3400)
    lower, upper = joint.ends(math.radians(-10))
    assert lower == pytest.approx(math.radians(-10))
    assert upper - lower == pytest.approx(2700 * 2 * math.pi / 4096)
    assert radians_to_lerobot(lower, "range_0_100", lower, upper, bool(drive_mode)) == 0
