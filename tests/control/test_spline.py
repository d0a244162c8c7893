"""Splines: through their points, as smooth as the fields given, and true to their derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.control.spline import Spline, smooth_velocities

MS = 1_000_000
rows = st.tuples(st.floats(-2, 2), st.floats(-2, 2))
knots = st.lists(st.tuples(st.integers(10 * MS, 2000 * MS), rows, rows, rows), min_size=2, max_size=6)


@pytest.mark.parametrize("order", [1, 3, 5])
@given(knots)
@settings(max_examples=50)
def test_a_spline_passes_its_points_and_is_as_smooth_as_the_fields_given(order: int, points: list[Any]) -> None:
    times_ns = np.cumsum([p[0] for p in points])
    positions, velocities, accelerations = (np.array([p[i] for p in points]) for i in (1, 2, 3))
    spline = Spline(times_ns, positions, velocities if order >= 3 else None, accelerations if order >= 5 else None)
    assert spline.end_ns == times_ns[-1]
    for index, time_ns in enumerate(times_ns[:-1].tolist()):
        sample = spline.at(time_ns)
        np.testing.assert_allclose(sample[0], positions[index], atol=1e-9)
        if order >= 3:
            np.testing.assert_allclose(sample[1], velocities[index], atol=1e-6)
        if order >= 5:
            np.testing.assert_allclose(sample[2], accelerations[index], atol=1e-4)
    for time_ns in times_ns[1:].tolist():  # from the left, 1 ns before
        index = times_ns.tolist().index(time_ns)
        left = spline.at(time_ns - 1)
        shortest = min(p[0] for p in points) / 1e9
        np.testing.assert_allclose(left[0], positions[index], atol=1e-6)
        if order >= 3:
            np.testing.assert_allclose(left[1], velocities[index], atol=1e-6 + 1e-7 / shortest**2)
        if order >= 5:
            np.testing.assert_allclose(left[2], accelerations[index], atol=1e-4 + 1e-6 / shortest**3)


@given(knots, st.floats(0, 1))
@settings(max_examples=50)
def test_the_velocity_and_acceleration_of_a_spline_are_its_derivatives(points: list[Any], share: float) -> None:
    times_ns = np.cumsum([max(p[0], 100 * MS) for p in points])
    spline = Spline(times_ns, *(np.array([p[i] for p in points]) for i in (1, 2, 3)))
    step_ns = 10_000
    middle = int(times_ns[0] + step_ns + share * (times_ns[-1] - times_ns[0] - 3 * step_ns))
    before, here, after = (spline.at(middle + k * step_ns) for k in (-1, 0, 1))
    for order in (0, 1):
        slope = (after[order] - before[order]) / (2e-9 * step_ns)
        np.testing.assert_allclose(here[order + 1], slope, atol=0.5, rtol=1e-3)


@settings(deadline=None)
@given(count=st.integers(2, 60), seed=st.integers(0, 999))
def test_smooth_velocities_make_accelerations_continuous(count: int, seed: int) -> None:
    """The tridiagonal system that says so, solved in full: no acceleration at the beginning, rest at the end."""
    positions = np.random.default_rng(seed).uniform(-1, 1, (count, 2))
    system = 4 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    system[0, :2], system[-1] = (2, 1), 0
    system[-1, -1] = 1
    right = np.zeros_like(positions)
    right[0] = 3 * (positions[1] - positions[0])
    right[1:-1] = 3 * (positions[2:] - positions[:-2])
    expected = np.linalg.solve(system, right) / 0.1
    np.testing.assert_allclose(smooth_velocities(positions, 0.1), expected, atol=1e-7)
