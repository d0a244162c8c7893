"""Trajectories: from rest to rest, within the limits and close to them, and never beyond a segment's ends."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_mujoco.experts.trajectory import Limits, Trajectory
from ibrobot_mujoco.experts.way import Way

LIMITS = Limits(np.array([1.0, 2.0, 4.0]), np.array([5.0, 3.0, 20.0]))
positions = st.lists(st.floats(-2, 2), min_size=3, max_size=3).map(np.array)


@settings(deadline=None)
@given(start=positions, end=positions)
def test_a_segment_keeps_within_limits_and_touches_one(start: np.ndarray, end: np.ndarray) -> None:
    there = Way(start, LIMITS)
    there.to("there", end)
    (segment,) = there.segments
    times_s = np.linspace(0, segment.duration_s, 2001)
    way = Trajectory([segment]).at(times_s)
    np.testing.assert_allclose(way[0], start, atol=1e-12)
    np.testing.assert_allclose(way[-1], end, atol=1e-12)
    assert np.all(way >= np.minimum(start, end) - 1e-9)
    assert np.all(way <= np.maximum(start, end) + 1e-9)
    if np.abs(end - start).max() < 0.01:
        return
    step_s = times_s[1]
    velocity = np.abs(np.diff(way, axis=0)) / step_s / LIMITS.velocity
    acceleration = np.abs(np.diff(way, 2, axis=0)) / step_s**2 / LIMITS.acceleration
    assert 0.98 < max(velocity.max(), acceleration.max()) < 1.02
    assert velocity[0].max() < 0.01, "it does not begin at rest"
    assert velocity[-1].max() < 0.01, "it does not end at rest"


def test_segments_follow_one_another_and_the_ends_hold() -> None:
    here, there = np.zeros(3), np.ones(3)
    steps = Way(here, LIMITS)
    steps.rest("wait", 0.5)
    steps.to("go", there)
    steps.rest("stay", 0.25)
    way = Trajectory(steps.segments)
    ends_s = way.ends_s
    times_s = np.array([-1.0, 0.25, 0.5, ends_s[1], ends_s[2], 100.0])
    np.testing.assert_array_equal(way.index(times_s), [0, 0, 0, 1, 2, 2])
    np.testing.assert_allclose(way.at(times_s), [here, here, here, there, there, there], atol=1e-12)
