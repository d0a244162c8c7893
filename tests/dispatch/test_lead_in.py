"""Leading over to a chunk: where it begins and ends, and what it takes of the limits."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.dispatch.smoother import LeadIn

STEP_S = 1 / 30
VELOCITY, ACCELERATION = np.array([3.0, 1.0]), np.array([40.0, 5.0])
distances = st.tuples(st.floats(-3, 3), st.floats(-3, 3))
speeds = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))


def walk(length: int) -> np.ndarray:
    return np.cumsum(np.random.default_rng(1).normal(0, 0.001, (length, 2)), axis=0)


@given(distance=distances, speed=speeds, held=st.booleans())
def test_it_goes_on_from_before_and_ends_in_the_chunk_within_half_of_the_limits(
    distance: tuple[float, float], speed: tuple[float, float], held: bool
) -> None:
    chunk = walk(900)
    here = chunk[0] + distance
    before = np.array([here]) if held else np.array([here, here + np.array(speed) * STEP_S])
    result = LeadIn(STEP_S, VELOCITY, ACCELERATION)(before, chunk)
    np.testing.assert_allclose(result[0], here, atol=1e-12)
    np.testing.assert_allclose(result[-1], chunk[-1], atol=1e-12)
    added = result - chunk
    if (here != chunk[0]).any():
        missing = before[-1] - before[0] - (chunk[1] - chunk[0])
        change = 0.5 * ACCELERATION * STEP_S**2 + 1e-9
        assert (np.abs(np.diff(added, 2, axis=0)) <= change).all()
        assert (np.abs(added[1] - added[0] - missing) <= change).all(), (
            "at the speed of before, but for a step's change"
        )
        fastest = np.maximum(np.abs(missing), 0.5 * VELOCITY * STEP_S + np.abs(missing) / 3)
        assert (np.abs(np.diff(added, axis=0)) <= fastest + 1e-9).all()


def test_without_a_distance_the_chunk_stays() -> None:
    chunk = walk(8)
    np.testing.assert_array_equal(LeadIn(STEP_S, VELOCITY, ACCELERATION)(chunk[:1], chunk), chunk)


def test_a_chunk_that_is_too_short_ends_on_the_way() -> None:
    chunk = np.zeros((3, 2))
    result = LeadIn(STEP_S, VELOCITY, ACCELERATION)(np.ones((1, 2)), chunk)
    np.testing.assert_array_equal(result[0], np.ones(2))
    assert (result[-1] > 0.5).all()


def test_a_chunk_of_one_action_begins_where_the_arm_is() -> None:
    result = LeadIn(STEP_S, VELOCITY, ACCELERATION)(np.ones((1, 2)), np.zeros((1, 2)))
    np.testing.assert_array_equal(result, np.ones((1, 2)))
