"""Ticks, radians and LeRobot's units: literal numbers of LeRobot 0.6, and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.units import (
    LEROBOT_MODES,
    lerobot_to_radians,
    lerobot_to_ticks,
    radians_to_lerobot,
    radians_to_ticks,
    ticks_to_lerobot,
    ticks_to_radians,
)

ranges = st.tuples(st.integers(0, 4095), st.integers(0, 4095)).filter(lambda r: r[0] < r[1])


def test_the_middle_tick_is_zero_and_a_quarter_turn_is_half_pi() -> None:
    assert ticks_to_radians(2048.0) == 0.0
    assert ticks_to_radians(3072.0) == pytest.approx(math.pi / 2)
    assert ticks_to_radians(3072.0, inverted=True) == pytest.approx(-math.pi / 2)
    assert ticks_to_radians(1000.0, zero=1000.0) == 0.0


@given(st.floats(-10, 10), st.floats(0, 4095), st.booleans())
def test_radians_come_back(radians: float, zero: float, inverted: bool) -> None:
    ticks = radians_to_ticks(radians, zero=zero, inverted=inverted)
    assert ticks_to_radians(ticks, zero=zero, inverted=inverted) == pytest.approx(radians, abs=1e-9)


@given(st.sampled_from(LEROBOT_MODES), ranges, st.floats(0, 1), st.floats(0, 4095), st.booleans())
def test_radians_within_the_range_come_back_from_lerobots_units(
    mode: str, limits: tuple[int, int], part: float, zero: float, inverted: bool
) -> None:
    low, high = limits
    radians = ticks_to_radians(low + part * (high - low), zero=zero, inverted=inverted)
    value = radians_to_lerobot(radians, mode, range_min=low, range_max=high, zero=zero, inverted=inverted)
    back = lerobot_to_radians(value, mode, range_min=low, range_max=high, zero=zero, inverted=inverted)
    assert back == pytest.approx(radians, abs=1e-9)


def test_arrays_are_converted_element_by_element() -> None:
    ticks = np.array([2048.0, 3072.0, 3072.0])
    found = ticks_to_radians(ticks, zero=np.array([2048.0, 2048.0, 3072.0]), inverted=np.array([False, True, False]))
    np.testing.assert_allclose(found, [0.0, -math.pi / 2, 0.0])
    back = radians_to_ticks(found, zero=np.array([2048.0, 2048.0, 3072.0]), inverted=np.array([False, True, False]))
    np.testing.assert_allclose(back, ticks)
    values = ticks_to_lerobot(
        np.array([1500, 1500, 9999]),
        "range_0_100",
        range_min=np.array([1000, 1000, 0]),
        range_max=3000,
        inverted=np.array([False, True, False]),
    )
    np.testing.assert_allclose(values, [25.0, 75.0, 100.0])
    ticks = lerobot_to_ticks(values, "range_0_100", range_min=np.array([1000, 1000, 0]), range_max=3000)
    np.testing.assert_allclose(ticks, [1500.0, 2500.0, 3000.0])


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
    assert ticks_to_lerobot(1500, mode, range_min=1000, range_max=3000, inverted=inverted) == expected


@given(st.sampled_from(LEROBOT_MODES), ranges, st.floats(0, 1), st.booleans())
def test_ticks_within_the_range_come_back(mode: str, limits: tuple[int, int], part: float, inverted: bool) -> None:
    low, high = limits
    ticks = low + part * (high - low)
    value = ticks_to_lerobot(ticks, mode, range_min=low, range_max=high, inverted=inverted)
    assert lerobot_to_ticks(value, mode, range_min=low, range_max=high, inverted=inverted) == pytest.approx(ticks)


@pytest.mark.parametrize("ticks", [-10, 0, 5000])
def test_ranges_clip_and_degrees_do_not(ticks: int) -> None:
    assert abs(ticks_to_lerobot(ticks, "range_m100_100", range_min=1000, range_max=3000)) == 100
    assert abs(ticks_to_lerobot(ticks, "degrees", range_min=1000, range_max=3000)) > 100


def test_an_unknown_unit_and_an_empty_range_are_refused() -> None:
    with pytest.raises(ValueError, match=r"unknown unit 'radian'; LeRobot has: range_m100_100, range_0_100, degrees"):
        ticks_to_lerobot(1, "radian", range_min=0, range_max=1)
    with pytest.raises(ValueError, match=r"range_min \(5\) must be below range_max \(5\)"):
        lerobot_to_ticks(1, "degrees", range_min=5, range_max=5)
