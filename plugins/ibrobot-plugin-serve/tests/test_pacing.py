"""Pacing: how a model's time is shared, and what does not change it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_serve.pacing import Pacing, fair_pace_ns

MS, S = 1_000_000, 1_000_000_000
TARGET = 0.8
"""Share of the model's time that is given away."""


def paced(counts: list[int], took_ms: float = 20.0, size: int = 1) -> int:
    """The pace after each robot asked so often, evenly over 5 s [ns]."""
    pacing = Pacing()
    pacing.work(size, round(took_ms * MS))
    for robot, count in enumerate(counts):
        for number in range(count):
            pacing.ask(f"robot {robot}", S + number * 5 * S // max(count, 1))
    return pacing.pace_ns(6 * S)


@given(st.lists(st.integers(0, 200), max_size=40), st.floats(1e5, 1e9))
def test_total_demand_stays_within_the_capacity(counts: list[int], cost_ns: float):
    pace_ns = fair_pace_ns(counts, cost_ns)
    if pace_ns:
        most = 5 * S / pace_ns
        assert sum(min(1.25 * count, most) for count in counts) * cost_ns <= 1.001 * TARGET * 5 * S
        assert most < 1.25 * max(counts), "it is said only where it holds a robot back"
    elif len(counts) > 1:
        assert sum(1.25 * count for count in counts) * cost_ns <= 1.001 * TARGET * 5 * S


@given(st.lists(st.integers(0, 200), min_size=2, max_size=40), st.floats(1e5, 1e9), st.randoms())
def test_pace_does_not_depend_on_the_order_of_robots(counts: list[int], cost_ns: float, random):
    shuffled = random.sample(counts, len(counts))
    assert fair_pace_ns(shuffled, cost_ns) == pytest.approx(fair_pace_ns(counts, cost_ns), abs=1, rel=1e-9)


def test_forty_robots_at_half_a_chunk_are_held_back_and_thirty_are_not():
    assert paced([6] * 30) == 750 * MS, "a pace that they keep already, every 0.8 s"
    assert paced([6] * 40) == S
    assert paced([6] * 20) == 0


def test_frequent_requests_of_one_robot_do_not_slow_down_others():
    """29 robots take 0.58 of the 0.8; the thirtieth gets the rest."""
    pace_ns = paced([4] * 29 + [100])
    assert 5 * S / pace_ns == pytest.approx(0.8 * 5 / 0.02 - 29 * 1.25 * 4, rel=1e-3)


def test_a_robot_alone_and_a_model_of_unknown_speed_have_no_pace():
    assert paced([500]) == 0
    pacing = Pacing()
    pacing.ask("a", 0)
    pacing.ask("b", 0)
    assert pacing.pace_ns(S) == 0


def test_batched_requests_cost_less():
    assert paced([6] * 40, size=8) == 0


def test_a_model_that_stood_still_once_is_as_fast_as_before():
    pacing = Pacing()
    for took_ms in (20, 20, 20, 2000, 20):
        pacing.work(1, took_ms * MS)
    for robot in range(40):
        for number in range(6):
            pacing.ask(f"robot {robot}", number * 800 * MS)
    assert pacing.pace_ns(5 * S) == S


def test_robots_that_are_gone_are_forgotten():
    pacing = Pacing()
    pacing.work(1, 20 * MS)
    for robot in range(40):
        pacing.ask(f"robot {robot}", S)
    assert pacing.pace_ns(S) == 0, "one request each says little"
    for robot in range(40):
        for number in range(6):
            pacing.ask(f"robot {robot}", 2 * S + number * 100 * MS)
    assert pacing.pace_ns(3 * S) > 0
    assert pacing.pace_ns(9 * S) == 0
