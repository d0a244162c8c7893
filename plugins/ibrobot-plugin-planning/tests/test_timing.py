"""Timing: limits on velocity, acceleration and jerk, as an executor with quintic interpolation moves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_planning.planners.timing import Motion, timed

VELOCITY, ACCELERATION = np.array([3.0, 1.0, 2.0]), np.array([10.0, 20.0, 5.0])

points = st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=2, max_size=7)


def move(path, blend=0.3, window=0.05, **limits) -> Motion:
    path = np.array(path, dtype=float)
    blends = np.full(max(len(path) - 2, 0), blend)
    scale = limits.get("scale", 1.0)
    return timed(path, scale * VELOCITY, scale * ACCELERATION, blends=blends, window=window, step=0.01)


@settings(deadline=None)
@given(points, st.floats(0, 1), st.floats(0.1, 1), st.sampled_from([0.02, 0.05, 0.1]))
def test_motions_keep_the_limits_and_end_at_rest(path, blend, scale, window):
    motion = move(path, blend, window, scale=scale)
    positions, velocities, accelerations = motion.sampled(0.001)
    np.testing.assert_allclose(motion.positions[[0, -1]], [path[0], path[-1]], atol=1e-9)
    assert not motion.velocities[[0, -1]].any()
    assert not motion.accelerations[[0, -1]].any()
    assert (np.diff(motion.times) > 0).all()
    assert (np.abs(velocities) <= scale * VELOCITY).all()
    assert (np.abs(accelerations) <= scale * ACCELERATION).all()
    assert motion.jerk <= 2 * scale * ACCELERATION.max() / window * 1.01
    # Corners are cut on their inside; at a stop, the quintic goes microradians past it.
    assert (positions >= np.min(path, axis=0) - 5e-6).all()
    assert (positions <= np.max(path, axis=0) + 5e-6).all()


@settings(deadline=None, max_examples=20)
@given(points)
def test_motions_that_stop_at_corners_stay_on_the_path(path):
    positions = move(path, blend=0).sampled(0.001)[0]
    distance = np.full(len(positions), np.inf)
    for a, b in zip(np.array(path), np.array(path[1:]), strict=False):
        length = max((b - a) @ (b - a), 1e-18)
        share = np.clip((positions - a) @ (b - a) / length, 0, 1)
        distance = np.minimum(distance, np.linalg.norm(positions - a - share[:, None] * (b - a), axis=1))
    assert distance.max() < 5e-6


def test_a_straight_line_takes_the_least_time_besides_the_smoothing():
    motion = timed(np.array([[0.0], [1.0]]), VELOCITY[:1], ACCELERATION[:1], blends=np.zeros(0), window=0.05, step=0.01)
    # Speeds up to 3 rad/s within 0.45 m: 10 rad/s^2 for half of the way, then the same back.
    assert motion.duration == pytest.approx(2 * np.sqrt(1 / 10) + 0.05, rel=0.01)
    far = timed(np.array([[0.0], [6.0]]), VELOCITY[:1], ACCELERATION[:1], blends=np.zeros(0), window=0.05, step=0.01)
    assert far.duration == pytest.approx(6 / 3 + 3 / 10 + 0.05, rel=0.01)


def test_blended_corners_save_time():
    path = [[0, 0, 0], [1, 0, 0], [1, 0.5, 0], [0, 0.5, 0]]
    assert move(path, 0.4).duration < 0.9 * move(path, 0).duration


def test_a_wider_average_has_less_jerk_and_takes_longer():
    path = [[0, 0, 0], [1, 0.5, 0.3]]
    sharp, soft = move(path, window=0.02), move(path, window=0.1)
    assert soft.jerk < 0.3 * sharp.jerk
    assert sharp.duration < soft.duration < sharp.duration + 0.09


def test_repeated_waypoints_count_once():
    path = [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]]
    np.testing.assert_allclose(move(path, 0).duration, move([[0, 0, 0], [1, 0, 0]]).duration)


def test_a_path_of_one_place_stays_there():
    motion = move([[0.1, 0.2, 0.3], [0.1, 0.2, 0.3]])
    np.testing.assert_array_equal(motion.positions, [[0.1, 0.2, 0.3]] * 2)
    assert motion.duration > 0


def test_corners_use_the_limits_up():
    """Blends are no reason to slow the whole motion: somewhere on each part a joint is at a limit."""
    motion = move([[0, 0, 0], [1, 0.5, 0.3], [1.5, -0.5, 0.6], [0, -1, 0.2]], blend=0.2, window=0.004)
    _, velocities, accelerations = motion.sampled(0.002)
    used = np.maximum(np.abs(velocities) / VELOCITY, np.abs(accelerations) / ACCELERATION).max(axis=1)
    assert np.median(used) > 0.97


def test_fine_positions_are_samples_of_the_motion():
    motion = move([[0, 0, 0], [1, 0.5, 0.3], [1.5, -0.5, 0.6]])
    fine = motion.positions_within(0.001)
    np.testing.assert_allclose(fine[[0, -1]], motion.positions[[0, -1]])
    assert len(fine) >= motion.duration / 0.001
    every = (len(fine) - 1) // (len(motion.times) - 1)
    np.testing.assert_allclose(fine[::every], motion.positions, atol=1e-12)
    velocities, accelerations = motion.peaks
    _, sampled, rates = motion.sampled(0.0005)
    np.testing.assert_allclose(velocities, np.abs(sampled).max(axis=0), rtol=1e-3)
    np.testing.assert_allclose(accelerations, np.abs(rates).max(axis=0), rtol=1e-2)
