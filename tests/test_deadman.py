"""A deadman counts only after it was seen released, and silence disarms it."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakeTeleop

from ibrobot_core.deadman import Deadman
from ibrobot_core.interfaces import teleop
from ibrobot_core.units import ns

T0 = 1_000_000_000_000
TICK = 10_000_000


def pressed_deadman(now_ns: int = T0) -> Deadman:
    """A deadman that was seen released and is pressed at `now_ns`."""
    deadman = Deadman()
    deadman.disarm(now_ns - 3 * TICK)
    deadman.report(False, now_ns - 2 * TICK)
    deadman.report(True, now_ns - TICK)
    deadman.report(True, now_ns)
    assert deadman.allows(now_ns)
    return deadman


def hold(deadman: Deadman, from_ns: int, ticks: int) -> list[bool]:
    """What it allows at each tick, while the device reports that it is pressed."""
    allowed = []
    for tick in range(ticks):
        deadman.report(True, from_ns + tick * TICK)
        allowed.append(deadman.allows(from_ns + tick * TICK))
    return allowed


def test_a_press_that_nobody_saw_begin_moves_nothing():
    assert not any(hold(Deadman(), T0, 100))


def test_all_threads_of_a_device_see_one_deadman(monkeypatch: pytest.MonkeyPatch):
    """A device reports in a thread of its own, perhaps before the run has looked at it."""
    device = FakeTeleop(host_context())
    both = threading.Barrier(2)

    def make() -> Deadman:
        both.wait(30.0)
        return Deadman()

    monkeypatch.setattr(teleop, "Deadman", make)
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: device.deadman, range(2))
    assert first is second


def test_a_held_deadman_allows_motion_until_its_release():
    deadman = pressed_deadman()
    assert all(hold(deadman, T0 + TICK, 100))
    deadman.report(False, T0 + 101 * TICK)
    assert not deadman.allows(T0 + 101 * TICK)
    assert hold(deadman, T0 + 102 * TICK, 2) == [True, True]


def test_after_disarm_it_must_be_released_and_pressed_again():
    deadman = pressed_deadman()
    deadman.disarm(T0)
    assert not any(hold(deadman, T0 + TICK, 100))
    deadman.report(False, T0 + 101 * TICK)
    assert hold(deadman, T0 + 102 * TICK, 2) == [True, True]


def test_reports_made_before_disarm_do_not_count():
    deadman = pressed_deadman()
    deadman.disarm(T0 + 10 * TICK)
    deadman.report(False, T0 + 9 * TICK)
    deadman.report(True, T0 + 10 * TICK)
    assert not deadman.armed
    assert not any(hold(deadman, T0 + 11 * TICK, 10))


@pytest.mark.parametrize("silent_s", [0.3, 2.0, 60.0])
@pytest.mark.parametrize("asked", [True, False], ids=["asked meanwhile", "not asked"])
def test_a_press_does_not_outlive_a_silence(silent_s: float, asked: bool):
    deadman = pressed_deadman()
    after_ns = T0 + ns(silent_s)
    if asked:
        for now_ns in range(T0, after_ns, TICK):
            deadman.allows(now_ns)
        assert not deadman.allows(after_ns)
    assert not any(hold(deadman, after_ns, 100))


@given(st.floats(0.0, 1.0))
def test_silence_and_braking_end_within_the_limit(braking_s: float):
    deadman = pressed_deadman()
    deadman.braking_s = braking_s
    ended_ns = next(now for now in range(T0, T0 + ns(1), TICK) if not deadman.allows(now))
    if braking_s <= 0.15:
        assert ended_ns - T0 + ns(braking_s) <= ns(Deadman.hold_s)
    assert ended_ns - T0 >= 4 * TICK, "reports at 60 Hz do not count as silence"


def test_a_paused_host_disarms_whatever_was_reported_meanwhile():
    """The reports that waited are read at once, those of a slower reader a little later."""
    deadman = pressed_deadman()
    now_ns = T0 + ns(2)
    for pressed in (False, True):
        deadman.report(pressed, now_ns)
    assert not deadman.allows(now_ns)
    for pressed in (False, True):
        deadman.report(pressed, now_ns + TICK)
    assert not deadman.allows(now_ns + TICK)
    assert not any(hold(deadman, now_ns + 2 * TICK, 100))
    deadman.report(False, now_ns + 102 * TICK)
    assert hold(deadman, now_ns + 103 * TICK, 1) == [True]


def test_a_report_from_the_future_does_not_last():
    deadman = pressed_deadman()
    deadman.report(True, T0 + ns(3600))
    assert not deadman.allows(T0 + TICK)
    assert not any(hold(deadman, T0 + 2 * TICK, 100))


def test_only_a_release_or_a_silence_leaves_time_to_brake():
    released = pressed_deadman()
    released.report(False, T0 + TICK)
    assert released.brakes(T0 + 2 * TICK)
    assert not released.brakes(T0 + TICK + ns(0.11))
    silent = pressed_deadman()
    assert not silent.allows(T0 + ns(0.29))
    assert silent.brakes(T0 + ns(0.3))
    stopped = pressed_deadman()
    stopped.disarm(T0)
    assert not stopped.brakes(T0 + TICK)


EVENTS = st.lists(
    st.tuples(st.sampled_from(["press", "release", "disarm", "silence", "pause"]), st.integers(1, 20)), max_size=40
)


@given(EVENTS)
def test_motion_needs_a_release_and_then_a_press_since_the_last_event(events: list[tuple[str, int]]):
    """The rule as a sentence, against the state machine."""
    deadman = Deadman()
    now_ns = T0
    seen: list[str] = []
    deadman.disarm(now_ns)
    for event, ticks in events:
        if event == "pause":
            now_ns += ns(Deadman.hold_s) + TICK
            deadman.allows(now_ns)
            now_ns += 11 * TICK  # reports from before the pause
            deadman.allows(now_ns)
            seen = []
        for _ in range(ticks):
            now_ns += TICK
            if event in ("press", "release"):
                deadman.report(event == "press", now_ns)
                seen = [*seen[-1:], event] if seen[-1:] != [event] else seen
            elif event == "disarm":
                deadman.disarm(now_ns)
                seen = []
            elif event == "silence" and not deadman.allows(now_ns) and seen[-1:] == ["press"]:
                seen = []
            if deadman.allows(now_ns):
                assert seen == ["release", "press"]


def test_a_motion_that_slows_down_may_do_so_for_as_long_as_it_needed_at_its_end():
    """The run updates `braking_s` with the velocity, which falls meanwhile."""
    deadman = pressed_deadman()
    deadman.braking_s = 0.15
    deadman.report(False, T0 + TICK)
    for tick in range(15):
        now_ns = T0 + (1 + tick) * TICK
        deadman.braking_s = 0.15 - tick * 0.01
        assert deadman.brakes(now_ns), tick
    assert not deadman.brakes(T0 + 17 * TICK)
