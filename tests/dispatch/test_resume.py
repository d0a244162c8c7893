"""Leading over from a held position: where it begins and ends, and what it takes of the limits."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.dispatch.resume import LeadIn

STEP_S = 1 / 30
VELOCITY, ACCELERATION = np.array([3.0, 1.0]), np.array([40.0, 5.0])
gaps = st.tuples(st.floats(-3, 3), st.floats(-3, 3))


@given(gap=gaps)
def test_it_begins_at_the_held_position_and_ends_in_the_chunk_within_half_of_the_limits(
    gap: tuple[float, float],
) -> None:
    chunk = np.cumsum(np.random.default_rng(1).normal(0, 0.01, (600, 2)), axis=0)
    held = chunk[0] + gap
    result = LeadIn(STEP_S, VELOCITY, ACCELERATION)(held, chunk)
    np.testing.assert_allclose(result[0], held, atol=1e-12)
    np.testing.assert_array_equal(result[-1], chunk[-1])
    added = result - chunk
    assert (np.abs(np.diff(added, axis=0)) <= 0.5 * VELOCITY * STEP_S + 1e-9).all()
    assert (np.abs(np.diff(added, 2, axis=0)) <= 0.5 * ACCELERATION * STEP_S**2 + 1e-9).all()
    assert (np.sign(added) * np.sign(held - chunk[0]) >= 0).all(), "it does not overshoot"


def test_without_a_distance_the_chunk_stays() -> None:
    chunk = np.arange(8.0).reshape(4, 2)
    np.testing.assert_array_equal(LeadIn(STEP_S, VELOCITY, ACCELERATION)(chunk[0], chunk), chunk)


def test_a_chunk_that_is_too_short_ends_on_the_way() -> None:
    chunk = np.zeros((3, 2))
    result = LeadIn(STEP_S, VELOCITY, ACCELERATION)(np.ones(2), chunk)
    np.testing.assert_array_equal(result[0], np.ones(2))
    assert (result[-1] > 0.5).all()
