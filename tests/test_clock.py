"""The clocks."""

from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.units import ns, seconds


def test_real_time_is_the_date_and_never_runs_backwards() -> None:
    clock = RealClock()
    stamps = [clock.now_ns() for _ in range(1000)]

    assert stamps == sorted(stamps)
    assert abs(stamps[0] - time.time_ns()) < ns(600.0)


def test_clocks_of_one_run_agree() -> None:
    host = RealClock()
    control = RealClock(host.epoch_offset_ns)
    before, between, after = host.now_ns(), control.now_ns(), host.now_ns()

    assert before <= between <= after


def test_real_sleep_ends_at_the_deadline_and_not_before() -> None:
    clock = RealClock()
    deadline = clock.now_ns() + ns(0.002)

    clock.sleep_until(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until(deadline - ns(3600.0))  # long past: returns


@given(st.lists(st.integers(0, 10**12)))
def test_stepped_time_moves_only_by_advance(steps: list[int]) -> None:
    clock = SteppedClock(5)

    for step in steps:
        before = clock.now_ns()
        assert clock.advance(step) == before + step
    assert clock.now_ns() == 5 + sum(steps)


def test_stepped_sleep_moves_forwards_only() -> None:
    clock = SteppedClock(100)

    clock.sleep_until(150)
    assert clock.now_ns() == 150
    clock.sleep_until(120)
    assert clock.now_ns() == 150
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        clock.advance(-1)
    assert clock.now_ns() == 150


@given(st.integers(0, 2**52))
def test_nanoseconds_survive_the_way_through_seconds(stamp: int) -> None:
    assert ns(seconds(stamp)) == pytest.approx(stamp, abs=1)


class _SetClock(SteppedClock):
    """A clock whose computer was set to another time of day."""

    set_by_ns = 0

    def wall_ns(self) -> int:
        return self.now_ns() + self.set_by_ns


@pytest.mark.parametrize("set_by_s", [0.0, 3600.0, -3600.0])
def test_ages_follow_a_computer_whose_clock_is_set(set_by_s: float) -> None:
    clock = _SetClock(ns(1e9))
    clock.set_by_ns = ns(set_by_s)

    for now_ns in (clock.now_ns(), clock.wall_ns()):  # of this run, and of other computers
        assert clock.age_ns(now_ns - ns(0.2)) == ns(0.2)
        assert clock.refusal(now_ns - ns(0.5)) == clock.refusal(now_ns + ns(0.5)) == ""
        assert "more than 0.5 s off" in clock.refusal(now_ns - ns(0.6))
        assert "more than 0.5 s off" in clock.refusal(now_ns + ns(0.6))
    assert clock.refusal(0) == ""


@pytest.mark.parametrize("off_s", [0.6, 3.0, 3600.0, -3600.0, 3.2e7])
def test_commands_of_another_time_are_refused(off_s: float) -> None:
    clock = RealClock()

    assert "set the clocks" in clock.refusal(clock.now_ns() - ns(off_s))
