"""The profile from rest to rest: it arrives, keeps the limits, and takes no longer than they demand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_planning.planners.joint import RestToRest


def powers_of_ten(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


@given(powers_of_ten(-9, 2), powers_of_ten(-2, 2), powers_of_ten(-2, 3), powers_of_ten(-1, 5))
def test_arrives_at_rest_within_the_limits_and_no_phase_is_slower_than_they_demand(
    distance: float, velocity: float, acceleration: float, jerk: float
) -> None:
    profile = RestToRest(distance, velocity, acceleration, jerk)
    ends = np.array(profile.ends)
    lengths = np.diff(ends, prepend=0.0)
    assert profile.at(0.0) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(profile.at(ends[-1]), (distance, 0.0, 0.0), atol=1e-9 * distance)
    assert np.all(lengths >= 0)
    states = np.array([profile.at(time) for time in ends])
    # Integrated phase by phase: the jerk is at its limit but for phases 2, 4 and 6, where it is 0.
    jerks = jerk * np.array([1, 0, -1, 0, -1, 0, 1])
    way = speed = rate = 0.0
    for t, j, state in zip(lengths, jerks, states, strict=True):
        way += speed * t + rate * t**2 / 2 + j * t**3 / 6
        speed += rate * t + j * t**2 / 2
        rate += j * t
        scale = np.abs(states).max(axis=0)
        np.testing.assert_allclose(np.array(state) / scale, np.array([way, speed, rate]) / scale, atol=1e-6)
    assert states[:, 1].max() <= velocity * (1 + 1e-9)
    assert np.abs(states[:, 2]).max() <= acceleration * (1 + 1e-9)
    # Time-optimal: it neither cruises below the greatest speed, nor keeps an acceleration below the greatest.
    if lengths[3] > 1e-6 * ends[-1]:
        assert states[3, 1] == pytest.approx(velocity)
    if lengths[1] > 1e-6 * ends[-1]:
        assert states[0, 2] == pytest.approx(acceleration)


@pytest.mark.parametrize(
    ("distance", "velocity", "acceleration", "jerk", "duration"),
    [
        (3.0, 1.0, 40.0, 200.0, 3.141421356237),
        (1.0, 1.0, 2.0, 200.0, 1.51),
        (0.001, 3.0, 40.0, 200.0, 0.054288352332),
        (0.1, 3.0, 2.0, 200.0, 0.457325384927),
        (1.2, 3.0, 40.0, 1e4, 0.479),
        (0.5, 0.05, 2.0, 4.0, 10.22360679775),
    ],
)
def test_durations_are_those_of_an_established_library(
    distance: float, velocity: float, acceleration: float, jerk: float, duration: float
) -> None:
    """The numbers are ruckig 0.19's."""
    assert RestToRest(distance, velocity, acceleration, jerk).ends[-1] == pytest.approx(duration, rel=1e-9)
