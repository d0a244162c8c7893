"""The trajectory executor in stepped time: splines, splices, tolerances, refusals."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_planning.executors.options import TrajectoryOptions
from ibrobot_planning.executors.trajectory import TrajectoryExecutor

from ibrobot_core.api import (
    Context,
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    GoalState,
    GoalStatus,
    Header,
    Joint,
    JointReading,
    JointTrajectory,
    JointTrajectoryPoint,
    MoveJoint,
    Robot,
    SlowDown,
    SteppedClock,
    Vector,
    ns,
)

MS = 1_000_000
ROBOT = Robot(
    name="robot",
    joints=tuple(Joint(name=n, lower=-3, upper=3, max_velocity=1, max_acceleration=1) for n in ("pan", "lift", "roll")),
)


def point(time_s: float, positions: Any, velocities: Any = (), accelerations: Any = ()) -> JointTrajectoryPoint:
    return JointTrajectoryPoint(ns(time_s), positions, velocities, accelerations)


def goal(
    *points: JointTrajectoryPoint, joint_names: tuple[str, ...] = ("pan", "roll"), **more: Any
) -> FollowTrajectory:
    return FollowTrajectory(JointTrajectory(Header(), joint_names, points), **more)


class Arm:
    """Two joints that stand, at each tick, at the last setpoint plus `off`."""

    def __init__(self, start: tuple[float, float] = (0.0, 0.0), **options: Any) -> None:
        context = Context(
            name="arm", clock=SteppedClock(), log=logging.getLogger("test"), robot=ROBOT, joints=("pan", "roll")
        )
        self.executor = TrajectoryExecutor(TrajectoryOptions(**options), context)
        self.now_ns, self.setpoint, self.off = 0, np.array(start), np.zeros(2)
        self.executor.activate(self.reading())

    def reading(self) -> JointReading:
        return JointReading(self.now_ns, self.setpoint + self.off, np.zeros(2), np.full(2, np.nan))

    def go(self, wanted: ExecutorGoal, goal_id: str = "goal") -> None:
        self.executor.set_goal(goal_id, wanted, self.reading())

    def at(self, time_s: float) -> list[float]:
        """Tick until `time_s`."""
        while True:
            self.now_ns = min(ns(time_s), self.now_ns + 10 * MS)
            self.setpoint = self.executor.update(self.reading())
            if self.now_ns == ns(time_s):
                return self.setpoint.tolist()

    def statuses(self) -> list[GoalStatus]:
        return [attrs.evolve(each, result={}) for each in iter(self.executor.pop_status, None)]


def test_it_holds_the_measured_position_after_activation() -> None:
    arm = Arm((0.3, -0.2))
    assert arm.at(5.0) == [0.3, -0.2]
    assert arm.statuses() == []


def test_positions_alone_make_straight_lines_from_the_present_setpoint() -> None:
    arm = Arm((0.0, 1.0))
    arm.go(goal(point(1.0, (1.0, 1.0)), point(2.0, (1.0, 0.0))))
    assert arm.at(0.0) == [0.0, 1.0]
    assert arm.at(0.25) == pytest.approx([0.25, 1.0])
    assert arm.at(1.0) == [1.0, 1.0]
    assert arm.at(1.5) == pytest.approx([1.0, 0.5])
    assert arm.at(2.0) == [1.0, 0.0]
    assert arm.at(9.0) == [1.0, 0.0]
    assert [s.state for s in arm.statuses()] == [GoalState.EXECUTING, GoalState.SUCCEEDED]


def test_joint_names_may_come_in_any_order() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (0.5, -0.5), (0.0, 0.0)), joint_names=("roll", "pan")))
    assert arm.at(1.0) == [-0.5, 0.5]


def test_velocities_make_cubics() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0), (0.0, 0.0))))
    assert arm.at(0.25) == pytest.approx([3 * 0.25**2 - 2 * 0.25**3, 0.0])


def test_rounding_takes_no_setpoint_beyond_the_limits() -> None:
    arm, rounded = Arm((2.0, 0.0)), (1e-9, -1e-9)
    arm.go(goal(point(1.0, (3.0, -3.0), rounded, (0.0, 0.0)), point(1.5, (3.0, -3.0), (0.0, 0.0), (0.0, 0.0))))
    assert max(np.abs(arm.at(tick / 100)).max() for tick in range(200)) == 3.0


@pytest.mark.parametrize(
    "points",
    [
        (point(1.0, (3.5, 0.0)), point(2.0, (2.9, 0.0))),
        (point(1.0, (9.0, 0.0)), point(2.0, (0.0, 0.0))),
        (point(1.0, (2.9, 0.0), (2.0, 0.0)), point(2.0, (2.9, 0.0), (0.0, 0.0))),
        (point(1.0, (2.9, 0.0), (2.0, 0.0), (0.0, 0.0)), point(2.0, (2.9, 0.0), (0.0, 0.0), (0.0, 0.0))),
    ],
    ids=["waypoint", "far waypoint", "cubic between points", "quintic between points"],
)
def test_trajectory_that_leaves_the_limits_anywhere_is_rejected(points: Any) -> None:
    arm = Arm((2.9, 0.0))
    with pytest.raises(GoalRejected, match=r"the trajectory leads pan to .* outside its limits"):
        arm.go(goal(*points, path_tolerance=-1))


def test_joint_that_begins_outside_its_limits_may_move_inwards() -> None:
    arm = Arm((3.2, 0.0))
    arm.go(goal(point(1.0, (2.5, 0.0), (0.0, 0.0))))
    assert arm.at(1.0)[0] == pytest.approx(2.5)
    with pytest.raises(GoalRejected, match="outside its limits"):
        Arm((3.2, 0.0)).go(goal(point(1.0, (3.4, 0.0)), point(2.0, (2.5, 0.0))))


@given(
    places=st.lists(st.floats(-3, 3), min_size=1, max_size=4),
    speeds=st.lists(st.floats(-9, 9), min_size=4, max_size=4),
    number=st.integers(1, 3),
)
@settings(max_examples=200, deadline=None)
def test_accepted_trajectory_stays_within_the_limits(places: list[float], speeds: list[float], number: int) -> None:
    def row(index: int, place: float) -> tuple[Any, ...]:
        speed = speeds[index] if index < len(places) - 1 else 0.0
        return ((place, 0.0), (speed, 0.0), (-speed, 0.0))[:number]

    arm = Arm((0.0, 0.0))
    try:
        arm.go(goal(*(point(0.5 * (i + 1), *row(i, place)) for i, place in enumerate(places)), path_tolerance=-1))
    except GoalRejected:
        return
    reached = [arm.at(tick / 100)[0] for tick in range(50 * len(places) + 1)]
    assert np.abs(reached).max() <= 3.0 + 1e-4


def test_accelerations_make_quintics() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0), (0.0, 0.0), (0.0, 0.0))))
    s = 0.25
    assert arm.at(s) == pytest.approx([10 * s**3 - 15 * s**4 + 6 * s**5, 0.0])


rows = st.tuples(st.floats(-2, 2), st.floats(-2, 2))


fields: dict[str, Callable[[Any], tuple[Any, ...]]] = {
    "linear": lambda p: (p,),
    "cubic": lambda p: (p, (0.0, 0.0)),
    "quintic": lambda p: (p, (0.0, 0.0), (0.0, 0.0)),
}


@settings(max_examples=40)
@given(rows, rows, st.floats(0.05, 1.5), st.sampled_from(list(fields)), st.sampled_from(list(fields)))
def test_a_new_goal_replaces_a_running_one_without_a_step(
    first: Any, second: Any, when: float, old: str, new: str
) -> None:
    def drive(replace: bool) -> list[Vector]:
        arm = Arm()
        arm.go(goal(point(1.0, *fields[old](first))))
        arm.at(when - 0.001)
        arm.at(when)
        if replace:
            arm.go(goal(point(1.0, *fields[new](second))), "second")
        return [np.array(arm.at(when + k * 0.0001)) for k in range(3)]

    went_on, replaced = drive(False), drive(True)
    np.testing.assert_allclose(replaced[0], went_on[0], atol=1e-12)
    if new != "linear" and not (old == "linear" and abs(when - 1.0) < 0.01):
        speeds = [(path[1] - path[0]) / 0.0001 for path in (went_on, replaced)]
        np.testing.assert_allclose(speeds[1], speeds[0], atol=0.01)


def test_a_replaced_goal_is_reported_as_cancelled() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 1.0))), "first")
    arm.at(0.5)
    arm.go(goal(point(1.0, (0.0, 0.0))), "second")
    arm.at(1.5)
    arm.at(1.51)
    assert arm.statuses() == [
        GoalStatus("first", GoalState.EXECUTING),
        GoalStatus("first", GoalState.CANCELED, "replaced by goal second"),
        GoalStatus("second", GoalState.EXECUTING),
        GoalStatus("second", GoalState.SUCCEEDED),
    ]


def test_a_point_at_time_zero_gives_way_to_the_present_setpoint_near_it() -> None:
    arm = Arm((0.0, 0.0))
    arm.go(goal(point(0.0, (0.05, 0.0)), point(1.0, (1.0, 0.0))))
    assert arm.at(0.0) == [0.0, 0.0]
    assert arm.at(0.5) == [0.5, 0.0]


def test_a_path_violation_aborts_and_holds_the_measured_position() -> None:
    arm = Arm(path_tolerance=0.1)
    arm.go(goal(point(1.0, (1.0, 0.0))))
    arm.at(0.05)
    arm.off = np.array([0.0, -0.2])
    arm.at(0.06)
    *_, status = arm.statuses()
    assert status.state is GoalState.ABORTED
    assert status.message == "roll is 0.2 rad off its path (tolerance 0.1), beyond a lag of 0.1 s"
    assert arm.setpoint.tolist() == pytest.approx([0.05, -0.2])
    held = arm.setpoint.tolist()
    arm.off = np.zeros(2)
    assert arm.at(2.0) == held


def test_the_goal_tolerance_is_waited_for_up_to_goal_time() -> None:
    arm = Arm(goal_tolerance=0.02, goal_time=0.5)
    arm.go(goal(point(1.0, (1.0, 0.0))))
    arm.at(0.99)
    arm.off = np.array([-0.1, 0.0])
    arm.at(1.0)
    arm.at(1.4)
    assert [s.state for s in arm.statuses()] == [GoalState.EXECUTING]
    arm.off = np.array([-0.01, 0.0])
    assert arm.at(1.41) == [1.0, 0.0]
    assert [s.state for s in arm.statuses()] == [GoalState.SUCCEEDED]


def test_a_goal_not_reached_within_goal_time_aborts_and_holds_the_measured_position() -> None:
    arm = Arm(goal_tolerance=0.02, goal_time=0.5)
    arm.go(goal(point(1.0, (1.0, 0.0))))
    arm.off = np.array([-0.1, 0.0])
    for time_s in (1.0, 1.49, 1.5):
        arm.at(time_s)
    status = arm.statuses()[-1]
    assert status.state is GoalState.ABORTED
    assert status.message == "pan is 0.1 rad off its goal (tolerance 0.02) 0.5 s after the end"
    assert arm.setpoint.tolist() == [0.9, 0.0]


@pytest.mark.parametrize(
    ("options", "more", "off", "ends"),
    [
        ({"path_tolerance": 0.1}, {}, 0.2, GoalState.ABORTED),
        ({"path_tolerance": 0.0}, {}, 0.2, GoalState.EXECUTING),  # 0 in the options: not checked
        ({"path_tolerance": 0.1}, {"path_tolerance": 0}, 0.2, GoalState.ABORTED),  # 0 in the goal: the options'
        ({"path_tolerance": 0.1}, {"path_tolerance": -1}, 0.2, GoalState.EXECUTING),  # -1 erases
        ({"path_tolerance": 0.1}, {"path_tolerance": 0.3}, 0.2, GoalState.EXECUTING),
        ({}, {"path_tolerance": 0.1}, 0.2, GoalState.ABORTED),
        ({}, {"path_tolerance": {"pan": 0.1}}, 0.2, GoalState.ABORTED),
        ({}, {"path_tolerance": {"roll": 0.1}}, 0.2, GoalState.EXECUTING),
        ({"path_tolerance": 0.1}, {"path_tolerance": {"pan": -1}}, 0.2, GoalState.EXECUTING),
    ],
)
def test_path_tolerances_of_options_and_goal(options: Any, more: Any, off: float, ends: GoalState) -> None:
    arm = Arm(**options)
    arm.go(goal(point(1.0, (0.5, 0.5)), **more))
    arm.off = np.array([off, 0.0])
    arm.at(0.01)
    assert arm.statuses()[-1].state is ends


@pytest.mark.parametrize(
    ("more", "after_end_s", "ends"),
    [
        ({}, 0.0, GoalState.EXECUTING),
        ({}, 1.0, GoalState.ABORTED),
        ({"goal_time": 0}, 1.0, GoalState.ABORTED),
        ({"goal_time": 2.0}, 1.0, GoalState.EXECUTING),
        ({"goal_time": -1}, 36.0, GoalState.EXECUTING),
        ({"goal_tolerance": -1}, 0.0, GoalState.SUCCEEDED),
        ({"goal_tolerance": 0.3}, 0.0, GoalState.SUCCEEDED),
        ({"goal_tolerance": 0}, 1.0, GoalState.ABORTED),
        ({"goal_tolerance": {"pan": 0.3}}, 0.0, GoalState.SUCCEEDED),
    ],
)
def test_goal_tolerances_and_goal_time_of_a_goal(more: Any, after_end_s: float, ends: GoalState) -> None:
    arm = Arm(goal_tolerance=0.02, goal_time=1.0)
    arm.go(goal(point(1.0, (0.5, 0.5)), **more))
    arm.at(0.99)
    arm.off = np.array([0.2, 0.0])
    arm.at(1.0 + after_end_s)
    assert arm.statuses()[-1].state is ends


def test_an_unmeasured_joint_is_within_no_tolerance_and_is_held_where_it_was_commanded_to_be() -> None:
    arm = Arm(path_tolerance=0.1)
    arm.go(goal(point(1.0, (1.0, 1.0))))
    arm.off = np.array([np.nan, 0.0])
    assert arm.at(0.01) == [0.01, 0.0]
    assert arm.statuses()[-1].state is GoalState.ABORTED


def test_cancelling_holds_the_measured_position() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0))))
    arm.at(0.5)
    arm.off = np.array([-0.02, 0.01])
    arm.executor.cancel(arm.reading())
    assert arm.at(0.51) == [0.48, 0.01]
    assert arm.statuses()[-1] == GoalStatus("goal", GoalState.CANCELED, "cancelled")
    arm.executor.cancel(arm.reading())
    assert arm.statuses() == []


def quintic(time_s: float, positions: Any) -> JointTrajectoryPoint:
    return point(time_s, positions, (0.0, 0.0), (0.0, 0.0))


def test_missed_ticks_delay_a_trajectory_and_skip_nothing() -> None:
    punctual, late = Arm(), Arm()
    for arm in (punctual, late):
        arm.go(goal(quintic(0.5, (0.1, -0.05))))
        arm.at(0.2)
    before = late.setpoint.copy()
    late.now_ns += 70 * MS
    late.setpoint = late.executor.update(late.reading())
    assert late.setpoint.tolist() == punctual.at(0.21), "one period further, not seven"
    assert (late.setpoint != before).all()
    late.at(1.0)
    assert [each.state for each in late.statuses()] == [GoalState.EXECUTING, GoalState.SUCCEEDED]


def test_trajectory_takes_over_at_a_time_of_the_running_one() -> None:
    alone, arm = Arm(), Arm()
    for each in (alone, arm):
        each.go(goal(quintic(1.0, (0.2, 0.1))), "first")
        each.at(0.2)
    # The same motion from 0.345 s on, between two ticks.
    position, velocity, acceleration = (np.array((0.2, 0.1)) * value for value in _rest_to_rest(0.345))
    rest = [point(0.0, position, velocity, acceleration), quintic(0.655, (0.2, 0.1))]
    arm.go(goal(*rest, takes_over="first", at_ns=345 * MS), "second")
    assert [each.goal_id for each in arm.statuses()] == ["first"]
    for time_s in (0.3, 0.34, 0.36, 0.5, 0.9, 1.0):
        assert arm.at(time_s) == pytest.approx(alone.at(time_s), abs=1e-9)
    arm.at(1.02)
    assert [(each.goal_id, each.state) for each in arm.statuses()] == [
        ("first", GoalState.CANCELED),
        ("second", GoalState.EXECUTING),
        ("second", GoalState.SUCCEEDED),
    ]


def _rest_to_rest(s: float) -> tuple[float, float, float]:
    """The quintic from 0 to 1, with its derivatives."""
    return 10 * s**3 - 15 * s**4 + 6 * s**5, 30 * s**2 - 60 * s**3 + 30 * s**4, 60 * s - 180 * s**2 + 120 * s**3


def test_executing_says_when_the_trajectory_began() -> None:
    arm = Arm()
    arm.at(0.1)
    arm.go(goal(quintic(1.0, (0.2, 0.1))), "first")
    arm.at(0.2)
    arm.go(goal(quintic(1.0, (0.0, 0.0)), takes_over="first", at_ns=115 * MS), "second")
    arm.at(0.3)
    begun = {s.goal_id: s.result["begin_ns"] for s in iter(arm.executor.pop_status, None) if s.result}
    assert begun == {"first": 100 * MS, "second": 215 * MS}


def test_stop_drops_a_trajectory_that_waits_to_take_over() -> None:
    arm = Arm()
    arm.go(goal(quintic(1.0, (0.2, 0.1))), "first")
    arm.at(0.2)
    arm.go(goal(quintic(1.0, (0.0, 0.0)), takes_over="first", at_ns=300 * MS), "second")
    arm.go(SlowDown(), "stop")
    arm.at(1.5)
    assert [(each.goal_id, each.state) for each in arm.statuses()] == [
        ("first", GoalState.EXECUTING),
        ("second", GoalState.CANCELED),
        ("first", GoalState.CANCELED),
        ("stop", GoalState.EXECUTING),
        ("stop", GoalState.SUCCEEDED),
    ]


@pytest.mark.parametrize(
    ("takes_over", "at_ns", "message"),
    [
        ("other", 0, "goal other does not run, so no trajectory can take over from it"),
        (
            "goal",
            100 * MS,
            "the trajectory takes over at 100000000 ns of goal goal, which is at 500000000 ns and ends at 1000000000 "
            "ns",
        ),
        (
            "goal",
            2000 * MS,
            "the trajectory takes over at 2000000000 ns of goal goal, which is at 500000000 ns and ends at 1000000000 "
            "ns",
        ),
    ],
)
def test_impossible_takeover_is_rejected_and_the_running_goal_goes_on(
    takes_over: str, at_ns: int, message: str
) -> None:
    arm = Arm()
    arm.go(goal(quintic(1.0, (0.2, 0.1))))
    arm.at(0.5)
    with pytest.raises(GoalRejected) as caught:
        arm.go(goal(quintic(1.0, (0.0, 0.0)), takes_over=takes_over, at_ns=at_ns), "second")
    assert str(caught.value) == message
    arm.at(1.01)
    assert [each.state for each in arm.statuses()] == [GoalState.EXECUTING, GoalState.SUCCEEDED]


def test_stop_slows_down_along_the_trajectory() -> None:
    arm = Arm()
    arm.go(goal(point(4.0, (1.0, 0.5))))
    arm.at(2.0)
    arm.go(SlowDown(), "stop")
    path = np.array([arm.at(time) for time in np.arange(2.01, 3.5, 0.01).tolist()])
    np.testing.assert_allclose(path[:, 1], path[:, 0] / 2, atol=1e-9)
    assert 0.5 < path[-1, 0] < 0.9
    assert (np.diff(path[:, 0]) >= 0).all()
    assert [(each.goal_id, each.state) for each in arm.statuses()] == [
        ("goal", GoalState.EXECUTING),
        ("goal", GoalState.CANCELED),
        ("stop", GoalState.EXECUTING),
        ("stop", GoalState.SUCCEEDED),
    ]


def test_stop_at_rest_succeeds_at_once() -> None:
    arm = Arm((0.2, 0.1))
    arm.go(SlowDown(), "stop")
    assert [each.state for each in arm.statuses()] == [GoalState.EXECUTING, GoalState.SUCCEEDED]
    assert arm.at(0.1) == [0.2, 0.1]


def test_deactivation_ends_the_goal() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0))))
    arm.executor.deactivate()
    assert arm.statuses()[-1] == GoalStatus("goal", GoalState.CANCELED, "the executor was deactivated")
    with pytest.raises(GoalRejected, match="not active"):
        arm.go(goal(point(1.0, (1.0, 0.0))))


AT_REST = (0.0, 0.0)
BAD: dict[str, Any] = {
    "the trajectory has no points; it needs at least one": goal(),
    "expected a trajectory, got MoveJoint(position=0.1, max_effort=0.0, speed=1.0)": MoveJoint(0.1),
    "the points have efforts; only positions, velocities and accelerations are followed": goal(
        attrs.evolve(point(1, AT_REST), effort=AT_REST)
    ),
    "joint_names must be, in any order, pan, roll; got pan": goal(point(1, AT_REST), joint_names=("pan",)),
    "joint_names must be, in any order, pan, roll; got pan, roll, lift": goal(
        point(1, AT_REST), joint_names=("pan", "roll", "lift")
    ),
    "joint_names must be, in any order, pan, roll; got pan, pan": goal(point(1, AT_REST), joint_names=("pan", "pan")),
    "point 1 is at 500000000 ns, not after the point before it at 1000000000 ns": goal(
        point(1, AT_REST), point(0.5, AT_REST)
    ),
    "point 1 is at 1000000000 ns, not after the point before it at 1000000000 ns": goal(
        point(1, AT_REST), point(1, AT_REST)
    ),
    "point 0 has time_from_start_ns -1000000000; it must be from 0 on": goal(point(-1, AT_REST)),
    "the last point is at time 0, which leaves no time to reach it": goal(point(0, AT_REST)),
    "the last point has roll at 0.1 rad/s; it must be at rest": goal(point(1, AT_REST, (0.0, 0.1))),
    "point 0 has positions [0.0]; it must be a list of 2 numbers": goal(point(1, (0.0,))),
    "point 1 has velocities [0.0, 0.0, 0.0]; it must be a list of 2 numbers": goal(
        point(1, AT_REST, AT_REST), point(2, AT_REST, (0.0, 0.0, 0.0))
    ),
    "point 0 has nan among its positions; each must be a finite number, up to 1e+06": goal(
        point(1, (0.0, float("nan")))
    ),
    "point 0 has inf among its velocities; each must be a finite number, up to 1e+06": goal(
        point(1, AT_REST, (float("inf"), 0.0)), point(2, AT_REST, AT_REST)
    ),
    "point 1 has no velocities but point 0 has; all or none must": goal(point(1, AT_REST, AT_REST), point(2, AT_REST)),
    "the points have accelerations but no velocities; give both, or positions alone": goal(
        point(1, AT_REST, (), AT_REST)
    ),
    "the points have no positions; every point needs them": goal(point(1, ())),
    "the last point has pan at 3.5 rad, outside its limits -3 to 3": goal(point(1, (3.5, 0.0))),
    "the trajectory starts with pan at 0.5 rad but it is at 0; it must start within 0.1 rad, or above time 0": goal(
        point(0, (0.5, 0.0)), point(1, AT_REST)
    ),
    "path_tolerance is -2; it must be above 0, or 0 for the default, or -1 for none": goal(
        point(1, AT_REST), path_tolerance=-2
    ),
    "goal_time is nan; it must be above 0, or 0 for the default, or -1 for none": goal(
        point(1, AT_REST), goal_time=float("nan")
    ),
    "goal_time is 1e+300; it must be at most 86400": goal(point(1, AT_REST), goal_time=1e300),
    "goal_tolerance names 'lift', which is not a joint here; the joints are pan, roll": goal(
        point(1, AT_REST), goal_tolerance={"lift": 1}
    ),
}


@pytest.mark.parametrize("message", BAD)
def test_a_bad_goal_is_rejected_precisely_and_the_old_one_goes_on(message: str) -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0))))
    with pytest.raises(GoalRejected) as caught:
        arm.go(BAD[message], "bad")
    assert str(caught.value) == message
    assert arm.at(0.5) == [0.5, 0.0]
    arm.at(1.0)
    arm.at(1.01)
    assert [(s.goal_id, s.state) for s in arm.statuses()] == [
        ("goal", GoalState.EXECUTING),
        ("goal", GoalState.SUCCEEDED),
    ]


def test_last_velocity_of_a_rounding_error_counts_as_rest() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (0.5, 0.0), (1e-7, 0.0))))
    assert arm.at(1.0) == [0.5, 0.0]
    assert arm.at(1.01) == [0.5, 0.0]
    assert [status.state for status in arm.statuses()] == [GoalState.EXECUTING, GoalState.SUCCEEDED]


def test_fields_given_as_empty_lists_are_not_given() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0), (), ())))
    assert arm.at(0.25) == [0.25, 0.0]


def test_what_is_given_out_is_the_callers_to_change() -> None:
    arm = Arm()
    arm.go(goal(point(1.0, (1.0, 0.0))))
    for time_s in (0.5, 1.0, 1.1, 1.2):
        arm.executor.update(JointReading(ns(time_s), np.array([1.0, 0.0]), np.zeros(2), np.zeros(2)))[:] = 9.0
    assert arm.at(1.3) == [1.0, 0.0]


class TestGuard:
    """What the guard holds back is not reached: the goal ends, and says why."""

    LABEL = '{"first": "hand", "second": "wall", "distance": 0.0031, "text": "hand was 3.1 mm from wall"}'

    def hold_back(self, arm: Arm, ticks: int, label: str = LABEL) -> None:
        for _ in range(ticks):
            arm.executor.note_guard(label)
            arm.at(arm.now_ns / 1e9 + 0.01)

    @pytest.mark.parametrize("at_s", [0.1, 0.5, 0.9])
    def test_a_trajectory_that_it_holds_back_is_aborted_with_the_pair(self, at_s: float) -> None:
        arm = Arm()
        arm.go(goal(point(2.0, (0.5, 0.5))))
        arm.at(at_s)
        self.hold_back(arm, 19)
        assert [each.state for each in arm.statuses()] == [GoalState.EXECUTING]
        arm.off = np.array([-0.02, 0.0])
        before = arm.setpoint + arm.off
        self.hold_back(arm, 1)
        assert arm.statuses() == [GoalStatus("goal", GoalState.ABORTED, "the guard: hand was 3.1 mm from wall")]
        assert arm.setpoint == pytest.approx(before), "it holds where the arm is"

    def test_a_stale_world_is_named(self) -> None:
        arm = Arm()
        arm.go(goal(point(2.0, (0.5, 0.5))))
        self.hold_back(arm, 20, '{"distance": null, "text": "world: cloud top is 2 s old"}')
        assert arm.statuses()[-1].message == "the guard: world: cloud top is 2 s old"

    def test_a_short_hold_passes(self) -> None:
        arm = Arm()
        arm.go(goal(point(1.0, (0.5, 0.5))))
        for _ in range(4):
            self.hold_back(arm, 19)
            arm.at(arm.now_ns / 1e9 + 0.01)
        arm.at(1.5)
        assert arm.statuses()[-1].state == GoalState.SUCCEEDED
