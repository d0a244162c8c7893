"""The joint planner, seen as an executor sees it: points, and the quintic between them."""

from __future__ import annotations

import logging
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_planning import ibrobot_planners
from ibrobot_planning.planner import JointGoal, PlanRequest, PoseGoal
from ibrobot_planning.planners.joint import JointPlanner
from ibrobot_planning.planners.options import JointPlannerOptions

from ibrobot_core.api import Context, Joint, JointTrajectory, PlanningError, Pose, Robot, SteppedClock

ROBOT = Robot(
    name="three",
    joints=(
        Joint("a", -2.0, 2.0, max_velocity=4.0, max_acceleration=20.0),
        Joint("b", -1.0, 3.0, max_velocity=1.0, max_acceleration=40.0),
        Joint("c", 0.0, 1.0, max_velocity=3.0, max_acceleration=2.0),
    ),
)
CONTEXT = Context("planner", SteppedClock(7), logging.getLogger("test"), ROBOT)
JERK = 200.0


def planner(**options: float) -> JointPlanner:
    return JointPlanner(JointPlannerOptions(max_jerk=JERK, **options), CONTEXT)


def request(start: list[float], goal: dict[str, float], **scaling: Any) -> PlanRequest:
    return PlanRequest(
        ROBOT.joint_names, np.array(start), JointGoal(tuple(goal), np.array(list(goal.values()))), **scaling
    )


def _derivatives(times: np.ndarray) -> np.ndarray:
    """Derivatives 0 to 3 of 1, t, … t^5 at `times`, shape (len(times), 4, 6)."""
    powers = [[[math.perm(k, d) * t ** max(k - d, 0) for k in range(6)] for d in range(4)] for t in times]
    return np.array(powers, dtype=float)


# Over the unit interval: position, velocity and acceleration at both ends -> the quintic's coefficients.
QUINTIC = np.linalg.inv(_derivatives(np.array([0.0, 1.0]))[:, :3].reshape(6, 6))
BASIS = _derivatives(np.linspace(0, 1, 7))


def sampled(trajectory: JointTrajectory) -> np.ndarray:
    """The quintic through the points: position, velocity, acceleration and jerk at many times, shape (N, 4, J)."""
    points = trajectory.points
    states = np.array([(p.positions, p.velocities, p.accelerations) for p in points])
    h = np.diff([p.time_from_start_ns for p in points]) / 1e9
    unit = (h[:, None] ** np.arange(4))[:, :, None]
    edges = np.concatenate([states[:-1] * unit[:, :3], states[1:] * unit[:, :3]], axis=1)
    samples = np.einsum("tdk,ke,nej->ntdj", BASIS, QUINTIC, edges) / unit[:, None]
    return samples.reshape(-1, 4, len(trajectory.joint_names))


positions = st.tuples(st.floats(-2, 2), st.floats(-1, 3), st.floats(0, 1)).map(list)
fractions = st.floats(0.05, 1.0)


@settings(deadline=None)
@given(positions, positions, fractions, fractions)
def test_a_plan_runs_from_rest_to_rest_on_a_straight_line_within_limits(start, goal, velocity, acceleration):
    asked = request(
        start, dict(zip("abc", goal, strict=True)), velocity_scaling=velocity, acceleration_scaling=acceleration
    )
    trajectory = planner().plan(asked).trajectory

    first, last = trajectory.points[0], trajectory.points[-1]
    assert trajectory.joint_names == ("a", "b", "c")
    assert first.time_from_start_ns == 0
    assert np.all(np.diff([p.time_from_start_ns for p in trajectory.points]) > 0)
    np.testing.assert_array_equal(first.positions, start)
    np.testing.assert_allclose(last.positions, goal, atol=1e-8)
    for point in (first, last):
        np.testing.assert_array_equal(point.velocities, np.zeros(3))
        np.testing.assert_array_equal(point.accelerations, np.zeros(3))
    position, speed, rate, _ = sampled(trajectory).swapaxes(0, 1)
    way = np.array(goal) - start
    assert np.all(np.abs(speed) <= ROBOT.max_velocity * velocity * (1 + 1e-6))
    # A phase too short for points of its own (10 us) lets the acceleration stray by what the jerk makes of that time.
    assert np.all(np.abs(rate) <= ROBOT.max_acceleration * acceleration + JERK * 1e-5)
    assert np.all((position >= np.minimum(start, goal) - 1e-9) & (position <= np.maximum(start, goal) + 1e-9))
    off_line = (position - start) * (way @ way) - np.outer((position - start) @ way, way)
    np.testing.assert_allclose(off_line, 0, atol=1e-8)


def test_a_long_plan_takes_the_least_time_that_the_tightest_limit_allows():
    trajectory = planner().plan(request([0, -1, 0], {"a": 1.0, "b": 2.0})).trajectory
    # Joint b sets the pace: the duration of a jerk-limited profile that reaches speed v and acceleration a is
    # distance / v + v / a + a / jerk, and here a = sqrt(v * jerk), which the limit on acceleration does not reach.
    peak = math.sqrt(1.0 * JERK)
    assert trajectory.points[-1].time_from_start_ns / 1e9 == pytest.approx(3.0 / 1.0 + 1.0 / peak + peak / JERK)
    assert max(abs(p.velocities[1]) for p in trajectory.points) == pytest.approx(1.0)
    assert max(abs(sample[3, 1]) for sample in sampled(trajectory)) == pytest.approx(JERK, rel=1e-3)


def test_the_tightest_acceleration_sets_the_pace_of_all():
    trajectory = planner().plan(request([0, 0, 0], {"a": 1.0, "c": 1.0})).trajectory
    assert max(abs(p.accelerations[2]) for p in trajectory.points) == pytest.approx(2.0)
    assert max(abs(p.accelerations[0]) for p in trajectory.points) == pytest.approx(2.0)


def test_a_slow_joint_with_a_short_way_slows_nobody():
    trajectory = planner().plan(request([-2, 0, 0], {"a": 2.0, "c": 0.1})).trajectory
    assert max(abs(p.accelerations[0]) for p in trajectory.points) == pytest.approx(20.0)


def test_scalings_of_the_options_and_of_the_request_multiply():
    slow = planner(velocity_scaling=0.5, acceleration_scaling=0.5)
    trajectory = slow.plan(request([0, -1, 0], {"b": 3.0}, velocity_scaling=0.5)).trajectory
    assert max(abs(p.velocities[1]) for p in trajectory.points) == pytest.approx(0.25)


def test_points_are_at_most_a_step_apart():
    trajectory = planner(step=0.05).plan(request([0, -1, 0], {"b": 3.0})).trajectory
    gaps = np.diff([p.time_from_start_ns for p in trajectory.points])
    assert gaps.max() <= 50_000_001


def test_joints_that_the_goal_does_not_name_stay():
    trajectory = planner().plan(request([0.3, 0.5, 0.7], {"b": 1.0})).trajectory
    for point in trajectory.points:
        assert (point.positions[0], point.positions[2]) == (0.3, 0.7)


def test_a_goal_that_is_the_start_stays_there_for_a_tick():
    trajectory = planner().plan(request([0.3, 0.5, 0.7], {"a": 0.3})).trajectory
    assert [point.time_from_start_ns for point in trajectory.points] == [0, CONTEXT.period_ns]
    for point in trajectory.points:
        np.testing.assert_array_equal(point.positions, [0.3, 0.5, 0.7])


def test_a_start_outside_the_limits_may_move_inwards():
    trajectory = planner().plan(request([2.1, 0, 0], {"a": 1.0})).trajectory
    np.testing.assert_array_equal(trajectory.points[0].positions, [2.1, 0, 0])


def test_some_of_the_joints_can_be_planned_in_another_order():
    asked = PlanRequest(("c", "a"), np.array([0.0, 1.0]), JointGoal(("a",), np.array([-1.0])))
    trajectory = planner().plan(asked).trajectory
    assert trajectory.joint_names == ("c", "a")
    np.testing.assert_array_equal(trajectory.points[-1].positions, [0.0, -1.0])


REFUSED = {
    "above the limit": (request([0, 0, 0], {"a": 2.5}), "goal of joint a is 2.5 rad, must be within -2.0 .. 2.0 rad"),
    "not a number": (request([0, 0, 0], {"b": math.nan}), "goal of joint b is nan rad, must be within -1.0 .. 3.0 rad"),
    "infinite": (request([0, 0, 0], {"b": math.inf}), "goal of joint b is inf rad, must be within -1.0 .. 3.0 rad"),
    "no such joint": (request([0, 0, 0], {"elbow": 0.0}), "no joint 'elbow'; the joints are: a, b, c"),
    "joint not planned": (
        PlanRequest(("a",), np.zeros(1), JointGoal(("b",), np.zeros(1))),
        "goal names joint 'b', which is not planned: a",
    ),
    "joint twice": (PlanRequest(("a",), np.zeros(1), JointGoal(("a", "a"), np.zeros(2))), "goal names joint 'a' twice"),
    "planned joint unknown": (
        PlanRequest(("x",), np.zeros(1), JointGoal(("a",), np.zeros(1))),
        "no joint 'x'; the joints are: a, b, c",
    ),
    "positions missing": (
        PlanRequest(("a",), np.zeros(1), JointGoal(("a",), np.zeros(2))),
        "goal has positions of shape (2,), must be (1,)",
    ),
    "start too short": (
        PlanRequest(("a", "b"), np.zeros(1), JointGoal(("a",), np.zeros(1))),
        "start has shape (1,), must be (2,): one per joint",
    ),
    "start not a number": (request([0, math.nan, 0], {"a": 1.0}), "start of joint b is nan, must be finite"),
    "speed above all": (
        request([0, 0, 0], {"a": 1.0}, velocity_scaling=1.5),
        "velocity_scaling is 1.5, must be from 0.01 to 1",
    ),
    "no acceleration": (
        request([0, 0, 0], {"a": 1.0}, acceleration_scaling=0.0),
        "acceleration_scaling is 0.0, must be from 0.01 to 1",
    ),
}


@pytest.mark.parametrize(("asked", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_refusals_name_the_joint_the_value_and_what_would_be_right(asked, message):
    with pytest.raises(PlanningError) as refused:
        planner().plan(asked)
    assert str(refused.value) == message


def test_a_pose_goal_is_refused_with_the_way_out():
    with pytest.raises(PlanningError, match=r"planner type 'joint' knows joint goals only.*another type of planner"):
        planner().plan(PlanRequest(ROBOT.joint_names, np.zeros(3), PoseGoal(Pose())))


def test_the_hook_offers_the_planner():
    descriptor, around_obstacles = ibrobot_planners()
    assert (descriptor.type, around_obstacles.type) == ("joint", "rrt_connect")
    assert isinstance(descriptor.make(descriptor.options(), CONTEXT), JointPlanner)
