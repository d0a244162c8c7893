"""The position executor in stepped time: interpolation, refusals, staleness."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.api import SlowDown
from ibrobot_core.clock import SteppedClock
from ibrobot_core.control.position import PositionExecutor
from ibrobot_core.descriptors import StreamOptions
from ibrobot_core.errors import GoalRejected
from ibrobot_core.interfaces import Context, JointReading, Plan
from ibrobot_core.robot import Joint, Robot

MS = 1_000_000
ROBOT = Robot(
    name="robot",
    joints=tuple(Joint(name=n, lower=-3, upper=3, max_velocity=1, max_acceleration=1) for n in ("pan", "lift", "roll")),
)


def make(**options: Any) -> PositionExecutor:
    context = Context(
        name="arm", clock=SteppedClock(), log=logging.getLogger("test"), robot=ROBOT, joints=("roll", "pan")
    )
    return PositionExecutor(StreamOptions(**options), context)


def reading(stamp_ns: int, *position: float) -> JointReading:
    measured = np.array(position or (0.5, -0.5))
    return JointReading(stamp_ns, measured, np.zeros(2), np.full(2, np.nan))


def at(executor: PositionExecutor, stamp_ms: float) -> list[float]:
    return executor.update(reading(round(stamp_ms * MS))).tolist()


def plan(start_ms: float, step_ms: float, *rows: tuple[float, float]) -> Plan:
    return Plan(round(start_ms * MS), round(step_ms * MS), np.array(rows))


def test_after_activation_it_holds_the_measured_position_without_growing_stale() -> None:
    executor = make(stale_timeout=0.1, safety_behavior="relax")
    executor.activate(reading(0, 0.1, 0.2))
    assert at(executor, 10) == [0.1, 0.2]
    assert at(executor, 10_000) == [0.1, 0.2]
    assert not executor.wants_relax
    assert executor.counters()["stale"] == 0


@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=2, max_size=20),
    st.integers(1, 100 * MS),
    st.floats(0, 1),
)
def test_the_plan_is_followed_through_its_setpoints_and_never_beyond_the_limits(
    rows: list[tuple[float, float]], step_ns: int, share: float
) -> None:
    positions = np.array(rows)
    within_ns = round(share * step_ns * (len(rows) - 2))
    for now_ns in (step_ns + within_ns, step_ns * (1 + within_ns // step_ns)):
        executor = make(stale_timeout=10.0)
        executor.activate(reading(0))
        executor.set_plan(Plan(0, step_ns, positions))
        setpoint = executor.update(reading(now_ns))
        assert (np.abs(setpoint) <= 3.0).all()
    np.testing.assert_allclose(setpoint, positions[now_ns // step_ns], atol=1e-8)


def test_setpoints_at_a_limit_are_not_passed_and_those_beyond_are_reached() -> None:
    executor = make(stale_timeout=10.0)
    executor.activate(reading(0, 2.0, 2.0))
    rows = ((2.0, 2.0), (3.0, 2.5), (3.0, 3.0), (2.0, 3.2), (1.0, 1.0))
    executor.set_plan(plan(0, 10, *rows))
    commanded = follow(executor, 10, 40)
    assert commanded.max(axis=0).tolist() == [3.0, 3.2]
    assert commanded[20].tolist() == pytest.approx([2.0, 3.2])


def follow(executor: PositionExecutor, begin_ms: int, end_ms: int) -> np.ndarray:
    return np.array([at(executor, ms) for ms in range(begin_ms, end_ms)])


def wave(first: int, last: int, offset: float = 0.0) -> np.ndarray:
    """A sine of 4 s, a setpoint every 30 ms."""
    phase = np.arange(first, last) * 0.03 * np.pi / 2
    return offset + np.stack((np.sin(phase), np.cos(phase)), axis=1)


def wave_at(ms: np.ndarray) -> np.ndarray:
    return np.stack((np.sin(ms * np.pi / 2000), np.cos(ms * np.pi / 2000)), axis=1)


def test_a_smooth_plan_is_followed_smoothly() -> None:
    executor = make()
    executor.activate(reading(0, *wave(0, 1)[0]))
    executor.set_plan(Plan(0, 30 * MS, wave(0, 60)))
    commanded = follow(executor, 30, 1500)
    np.testing.assert_allclose(commanded, wave_at(np.arange(30, 1500)), atol=1e-4)
    accelerations = np.diff(commanded[200:], 2, axis=0) * 1e6
    assert np.abs(accelerations).max() < 1.01 * (np.pi / 2) ** 2, "linearly it would be 33 times that"


def test_the_rest_of_the_same_plan_changes_nothing() -> None:
    executor, renewed = make(), make()
    for each in (executor, renewed):
        each.activate(reading(0, *wave(0, 1)[0]))
        each.set_plan(Plan(0, 30 * MS, wave(0, 60)))
    whole, pieces = follow(executor, 0, 1200), []
    for first in range(0, 1200, 45):
        pieces.append(follow(renewed, first, min(first + 45, 1200)))
        begun = (first + 44) // 30
        renewed.set_plan(Plan(begun * 30 * MS, 30 * MS, wave(begun, 60)))
    np.testing.assert_allclose(np.concatenate(pieces), whole, atol=2e-4)


def test_a_plan_beside_the_old_one_is_joined_within_a_step_without_a_jump() -> None:
    executor = make()
    executor.activate(reading(0, *wave(0, 1)[0]))
    executor.set_plan(Plan(0, 30 * MS, wave(0, 60)))
    before = follow(executor, 0, 500)
    executor.set_plan(Plan(480 * MS, 30 * MS, wave(16, 60, offset=0.1)))
    after = follow(executor, 500, 600)
    np.testing.assert_allclose(after[30:], wave_at(np.arange(530, 600)) + 0.1, atol=1e-3)
    speeds = np.diff(np.concatenate((before[-50:], after[:40])), axis=0)
    assert np.abs(speeds).max() < 1.5 * 0.1 / 30 + 0.002
    assert np.abs(np.diff(speeds, axis=0)).max() < 6 * 0.1 / 30**2 + 1e-4


def test_setpoints_are_given_exactly_at_their_times() -> None:
    executor = make()
    executor.activate(reading(0))
    rows = ((0.1, 0.2), (0.3, 0.1), (0.7, -0.9))
    executor.set_plan(plan(10, 10, *rows))
    assert [at(executor, ms) for ms in (10, 20, 30)] == [list(row) for row in rows]


def test_before_its_start_a_plan_is_held_back_and_approached_over_one_step() -> None:
    executor = make()
    executor.activate(reading(0, 0.0, 0.0))
    executor.set_plan(plan(100, 20, (1.0, 2.0), (1.0, 2.0)))
    assert at(executor, 40) == [0.0, 0.0]
    assert at(executor, 80) == [0.0, 0.0]
    assert at(executor, 90) == [0.5, 1.0]
    assert at(executor, 100) == [1.0, 2.0]


def test_a_new_plan_that_starts_within_a_step_is_approached_from_the_present_setpoint() -> None:
    executor = make()
    executor.activate(reading(0, 0.0, 0.0))
    executor.set_plan(plan(0, 100, (0.0, 0.0), (1.0, 1.0)))
    assert at(executor, 50) == [0.5, 0.5]
    executor.set_plan(plan(70, 100, (0.9, 0.9), (2.0, 2.0)))
    assert at(executor, 60) == pytest.approx([0.7, 0.7])
    assert at(executor, 70) == [0.9, 0.9]


def test_a_plan_of_length_one_is_followed_at_once() -> None:
    executor = make()
    executor.activate(reading(0))
    executor.set_plan(plan(10, 10, (0.7, 0.8)))
    assert at(executor, 10) == [0.7, 0.8]
    executor.set_plan(plan(15, 10, (0.6, 0.8)))
    assert at(executor, 20) == [0.6, 0.8]


def test_a_plan_that_ran_dry_is_held_and_counted_once_as_stale() -> None:
    executor = make(stale_timeout=0.25)
    executor.activate(reading(0))
    executor.set_plan(plan(0, 10, (0.0, 0.0), (0.3, 0.4)))
    assert at(executor, 10) == [0.3, 0.4]
    assert at(executor, 259) == [0.3, 0.4]
    assert executor.counters()["stale"] == 0
    assert at(executor, 260) == [0.3, 0.4]
    assert at(executor, 400) == [0.3, 0.4]
    assert executor.counters()["stale"] == 1
    assert not executor.wants_relax
    executor.set_plan(plan(400, 10, (0.1, 0.1)))
    assert at(executor, 410) == [0.1, 0.1]
    at(executor, 1000)
    assert executor.counters()["stale"] == 2


def test_a_plan_that_arrives_stale_moves_nothing() -> None:
    executor = make(stale_timeout=0.1)
    executor.activate(reading(0, 0.5, 0.5))
    at(executor, 1000)
    executor.set_plan(plan(0, 10, (1.0, 1.0), (2.0, 2.0)))
    assert at(executor, 1010) == [0.5, 0.5]
    assert executor.counters()["stale"] == 1


def test_relax_is_asked_for_while_stale_and_the_setpoint_follows_the_falling_arm() -> None:
    executor = make(stale_timeout=0.1, safety_behavior="relax")
    executor.activate(reading(0))
    executor.set_plan(plan(0, 10, (1.0, 1.0)))
    at(executor, 99)
    assert not executor.wants_relax
    assert executor.update(reading(100 * MS, 0.9, 0.8)).tolist() == [0.9, 0.8]
    assert executor.wants_relax
    assert executor.update(reading(110 * MS, 0.7, np.nan)).tolist() == [0.7, 0.8]
    executor.set_plan(plan(200, 100, (0.0, 0.0)))
    assert not executor.wants_relax
    assert at(executor, 150) == pytest.approx([0.7 * 50 / 90, 0.8 * 50 / 90])  # from where it lay, at 110 ms


@pytest.mark.parametrize(
    ("positions", "step_ns", "counter"),
    [
        (np.array([[np.nan, 0.0]]), MS, "refused_nonfinite"),
        (np.array([[0.0, 0.0], [0.0, np.inf]]), MS, "refused_nonfinite"),
        (np.zeros((1, 3)), MS, "refused_shape"),
        (np.zeros(2), MS, "refused_shape"),
        (np.zeros((0, 2)), MS, "refused_shape"),
        (np.zeros((1, 1, 2)), MS, "refused_shape"),
        ("nonsense", MS, "refused_shape"),
        ([[0.0], [0.0, 0.0]], MS, "refused_shape"),
        (np.zeros((1, 2)), 0, "refused_step"),
        (np.zeros((1, 2)), -MS, "refused_step"),
    ],
)
def test_a_bad_plan_is_refused_counted_and_the_old_one_stays(positions: Any, step_ns: int, counter: str) -> None:
    executor = make()
    executor.activate(reading(0))
    executor.set_plan(plan(0, 100, (0.0, 0.0), (1.0, 1.0)))
    executor.set_plan(Plan(0, step_ns, positions))
    assert at(executor, 100) == [1.0, 1.0]
    assert {name: count for name, count in executor.counters().items() if count} == {counter: 1}


def test_the_first_refusal_of_a_kind_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    executor = make()
    executor.activate(reading(0))
    for _ in range(3):
        executor.set_plan(Plan(0, MS, np.zeros((4, 7))))
    assert [record.getMessage() for record in caplog.records] == [
        "refused a plan: shape (4, 7), not (N, 2); further ones are counted as refused_shape"
    ]


def test_it_keeps_its_own_copy_of_a_plan_and_gives_out_copies() -> None:
    executor = make()
    executor.activate(reading(0))
    rows = np.array([[0.1, 0.2]])
    executor.set_plan(Plan(0, MS, rows))
    rows[:] = 9.0
    executor.update(reading(0))[:] = 9.0
    assert at(executor, 1) == [0.1, 0.2]


def test_deactivation_forgets_the_plan_and_activation_starts_from_the_measured_position() -> None:
    executor = make()
    executor.activate(reading(0))
    executor.set_plan(plan(0, 100, (0.0, 0.0), (1.0, 1.0)))
    at(executor, 50)
    executor.deactivate()
    executor.activate(reading(60 * MS, -1.0, 1.0))
    assert at(executor, 70) == [-1.0, 1.0]


def test_it_takes_plans_and_no_goals() -> None:
    executor = make()
    assert executor.accepts_plans
    assert executor.joints == ("roll", "pan")
    with pytest.raises(GoalRejected, match="accepts no goals"):
        executor.set_goal("1", SlowDown(), reading(0))
