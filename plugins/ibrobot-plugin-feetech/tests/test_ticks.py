"""Servo ticks and radians."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_feetech.ticks import radians_to_ticks, ticks_to_radians


def test_the_middle_tick_is_zero_and_a_quarter_turn_is_half_pi() -> None:
    assert ticks_to_radians(2048) == 0.0
    assert ticks_to_radians(3072) == pytest.approx(math.pi / 2)
    assert ticks_to_radians(3072, inverted=True) == pytest.approx(-math.pi / 2)
    assert ticks_to_radians(1000, zero=1000.0) == 0.0


@given(st.floats(-10, 10), st.floats(0, 4095), st.booleans())
def test_radians_come_back(radians: float, zero: float, inverted: bool) -> None:
    ticks = radians_to_ticks(radians, zero=zero, inverted=inverted)
    assert ticks_to_radians(ticks, zero=zero, inverted=inverted) == pytest.approx(radians, abs=1e-9)


def test_arrays_are_converted_element_by_element() -> None:
    ticks = np.array([2048.0, 3072.0, 3072.0])
    zero, inverted = np.array([2048.0, 2048.0, 3072.0]), np.array([False, True, False])
    found = ticks_to_radians(ticks, zero=zero, inverted=inverted)
    np.testing.assert_allclose(found, [0.0, -math.pi / 2, 0.0])
    np.testing.assert_allclose(radians_to_ticks(found, zero=zero, inverted=inverted), ticks)
