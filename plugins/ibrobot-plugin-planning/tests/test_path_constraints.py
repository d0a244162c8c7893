"""Path constraints of goals: their grammar, and motions that keep them, measured by MuJoCo at each millisecond."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import attrs
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_kinematics import PathConstraints
from ibrobot_kinematics.path_constraints import AXES
from ibrobot_planning.execution.requests import CartesianQuery
from ibrobot_planning.goals.grammar import GoalOptions, target
from ibrobot_planning.planner import (
    AnyGoal,
    ConstrainedGoal,
    Goal,
    JointGoal,
    LinearGoal,
    NamedGoal,
    PlanRequest,
    PlanResult,
    PoseGoal,
    PositionGoal,
    constrains,
)
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.planners.timing import Motion, motion_of, timed
from ibrobot_planning.world.objects import Sphere, World, WorldObject

from ibrobot_core.api import PlanCode, PlanningError, Pose, Robot, Vector, Vector3

from .table_arm import ARM, WALL, box, make_planner, make_robot, write_arm

TEN = math.radians(10.0)
DOWN = np.array([1.0, 0.4, 1.4, math.pi - 1.8, 0.0])
"""The tool points down."""
ACROSS = DOWN * [-1, 1, 1, 1, 1]
TILT = np.array([0.0, 0.0, 0.0, 0.4, 0.0])
UPRIGHT = PathConstraints(upright=TEN)


@pytest.fixture(scope="module")
def planner(tmp_path_factory) -> RrtConnectPlanner:
    """With a low wall between the two configurations."""
    return make_planner(tmp_path_factory.mktemp("planner"), World({"wall": box(0.2, 0, 0.06, 0.3, 0.02, 0.12)}))


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Robot:
    return make_robot(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def engine(tmp_path_factory) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(write_arm(tmp_path_factory.mktemp("engine"))))


def ask(goal: Goal, start: Vector = DOWN, **changes: Any) -> PlanRequest:
    return PlanRequest(ARM, np.array(start, dtype=float), goal, **changes)


def motion(result: PlanResult) -> Motion:
    made = motion_of(result.trajectory)
    assert made is not None
    return made


def tips(engine: mujoco.MjModel, result: PlanResult) -> tuple[Vector, Vector]:
    """Positions of the tool [m], shape (N, 3), and its axes, shape (N, 3, 3), at each millisecond, by MuJoCo."""
    data, places, turns = mujoco.MjData(engine), [], []
    for q in motion(result).sampled(0.001)[0]:
        data.qpos[:5] = q
        mujoco.mj_kinematics(engine, data)
        places.append(data.site("tip").xpos.copy())
        turns.append(data.site("tip").xmat.reshape(3, 3).copy())
    return np.array(places), np.array(turns)


def tilt(axes: Vector, axis: tuple[float, float, float] = (0, 0, -1)) -> float:
    """Greatest angle of an axis of the tool from the vertical [rad]."""
    return float(np.arccos(np.clip((axes @ axis)[:, 2], -1, 1)).max())


def refused(planner: RrtConnectPlanner, request: PlanRequest, code: PlanCode, message: str) -> None:
    with pytest.raises(PlanningError, match=message) as caught:
        planner.plan(request)
    assert caught.value.code is code


@pytest.mark.parametrize("seed", range(3))
def test_cup_stays_upright_over_a_wall(tmp_path, engine, seed):
    planner = make_planner(tmp_path, World({"wall": box(0.2, 0, 0.06, 0.3, 0.02, 0.12)}), seed)
    free = planner.plan(ask(JointGoal(ARM, ACROSS)))
    assert tilt(tips(engine, free)[1]) > TEN, "without the constraint it tilts"
    result = planner.plan(ask(ConstrainedGoal(JointGoal(ARM, ACROSS), UPRIGHT)))
    assert tilt(tips(engine, result)[1]) <= TEN
    planned = motion(result)
    np.testing.assert_allclose(planned.positions[[0, -1]], [DOWN, ACROSS], atol=1e-9)
    _, velocities, accelerations = planned.sampled(0.001)
    assert np.abs(velocities).max() <= 3.0
    assert np.abs(accelerations).max() <= 10.0
    assert planned.jerk <= 400.0


def test_equal_seeds_give_equal_trajectories(tmp_path, planner):
    request = ask(ConstrainedGoal(JointGoal(ARM, ACROSS), UPRIGHT))
    again = make_planner(tmp_path, planner.world).plan(request)
    np.testing.assert_array_equal(motion(planner.plan(request)).positions, motion(again).positions)


def test_positions_are_reached_upright(planner, engine):
    for place in ((0.2, -0.15, 0.1), (0.1, -0.2, 0.05)):
        result = planner.plan(ask(ConstrainedGoal(PositionGoal(Vector3(*place)), UPRIGHT)))
        places, axes = tips(engine, result)
        assert tilt(axes) <= TEN
        np.testing.assert_allclose(places[-1], place, atol=1e-3)


def test_tool_stays_in_a_region(tmp_path, engine):
    """The straight way swings the tool out of it."""
    planner, region = make_planner(tmp_path), (0.0, -0.3, 0.0, 0.15, 0.3, 0.3)
    places, _ = tips(engine, planner.plan(ask(JointGoal(ARM, ACROSS))))
    assert places[:, 0].max() > 0.17
    result = planner.plan(ask(ConstrainedGoal(JointGoal(ARM, ACROSS), PathConstraints(region=region))))
    places, _ = tips(engine, result)
    assert (places >= region[:3]).all()
    assert (places <= region[3:]).all()


def test_point_stays_in_view(planner, engine):
    constraints = PathConstraints(view=(0.15, 0.0, 0.0), view_angle=1.2, view_from=(0.0, 0.03, -0.02))
    result = planner.plan(ask(ConstrainedGoal(JointGoal(ARM, ACROSS), constraints)))
    places, axes = tips(engine, result)
    way = np.array([0.15, 0.0, 0.0]) - places - axes @ [0.0, 0.03, -0.02]
    cosines = (axes[:, :, 2] * way).sum(axis=1) / np.linalg.norm(way, axis=1)
    assert np.arccos(cosines).max() <= 1.2


def test_all_constraints_hold_together(planner, engine):
    constraints = PathConstraints(
        upright=TEN, region=(0.0, -0.3, 0.0, 0.3, 0.3, 0.3), view=(0.15, 0, 0), view_angle=1.3
    )
    places, axes = tips(engine, planner.plan(ask(ConstrainedGoal(JointGoal(ARM, ACROSS), constraints))))
    assert tilt(axes) <= TEN
    assert places[:, 2].max() <= 0.3


def test_lines_keep_constraints_or_end_early(planner, engine):
    def line(*waypoints: PositionGoal) -> ConstrainedGoal:
        return ConstrainedGoal(LinearGoal(waypoints), UPRIGHT)

    here = tips(engine, planner.plan(ask(JointGoal(ARM, DOWN))))[0][0]
    near = PositionGoal(Vector3(*(here + np.array([0.0, 0.0, 0.03])).tolist()), Vector3(0, 0, -1))
    assert tilt(tips(engine, planner.plan(ask(line(near))))[1]) <= TEN
    turned = attrs.evolve(near, axis=Vector3(0.5 * math.cos(1.0), 0.5 * math.sin(1.0), -1.0))
    refused(
        planner, ask(line(turned)), PlanCode.PLANNING_FAILED, r"asked: upright: the tool's -z axis is 1\d\.\d\d deg"
    )


def test_lines_with_a_free_orientation_keep_constraints(planner, engine):
    line = LinearGoal((PositionGoal(Vector3(0.14, 0.2, 0.14)),))
    assert tilt(tips(engine, planner.plan(ask(line)))[1]) > TEN
    places, axes = tips(engine, planner.plan(ask(ConstrainedGoal(line, UPRIGHT))))
    assert tilt(axes) <= TEN
    way, end = places - places[0], places[-1] - places[0]
    off = np.linalg.norm(way - np.outer(way @ end, end) / (end @ end), axis=1)
    assert off.max() < 1e-3, "it is straight"
    np.testing.assert_allclose(places[-1], [0.14, 0.2, 0.14], atol=1e-3)


def test_first_alternative_that_keeps_its_constraints_is_taken(planner, engine):
    tilted = ACROSS + TILT
    goals = tuple(ConstrainedGoal(JointGoal(ARM, each), UPRIGHT) for each in (tilted, ACROSS))
    result = planner.plan(ask(AnyGoal(goals)))
    assert result.alternative == 1
    assert tilt(tips(engine, result)[1]) <= TEN


def test_start_and_goal_that_break_a_constraint_are_refused_with_the_degrees(planner):
    tilted = DOWN + TILT
    words = r"upright: the tool's -z axis is 22\.92 degrees from the vertical, 10\.00 are allowed"
    to = ConstrainedGoal(JointGoal(ARM, ACROSS), UPRIGHT)
    refused(planner, ask(to, tilted), PlanCode.START_STATE_VIOLATES_PATH_CONSTRAINTS, f"the start breaks {words}")
    to = ConstrainedGoal(JointGoal(ARM, tilted), UPRIGHT)
    refused(planner, ask(to), PlanCode.GOAL_VIOLATES_PATH_CONSTRAINTS, f"the goal breaks {words}")
    up = ConstrainedGoal(PositionGoal(Vector3(0.2, -0.2, 0.12), Vector3(1, -1, 0)), UPRIGHT)
    none = (
        r"the goal breaks upright: the tool's -z axis is 9\d\.\d\d degrees.*no configuration at the position keeps it"
    )
    refused(planner, ask(up), PlanCode.GOAL_VIOLATES_PATH_CONSTRAINTS, none)
    outside = ConstrainedGoal(NamedGoal("left"), PathConstraints(region=(0, -0.3, 0, 0.3, 0.1, 0.3)))
    words = r"the start breaks region: the tool is at y = 0\.\d+ m, must be below its upper y, 0\.1000 m"
    refused(planner, ask(outside), PlanCode.START_STATE_VIOLATES_PATH_CONSTRAINTS, words)


def test_goal_with_a_tolerance_is_reached_where_the_constraint_holds(planner, engine):
    near = ConstrainedGoal(JointGoal(ARM, ACROSS + TILT, tolerance=0.3), UPRIGHT)
    result = planner.plan(ask(near))
    assert tilt(tips(engine, result)[1]) <= TEN
    far = ConstrainedGoal(JointGoal(ARM, ACROSS + TILT, tolerance=0.01), UPRIGHT)
    refused(
        planner, ask(far), PlanCode.GOAL_VIOLATES_PATH_CONSTRAINTS, r"upright: the tool's -z axis is 22\.92 degrees"
    )


def test_constraints_within_constraints_are_refused(planner):
    inner = ConstrainedGoal(JointGoal(ARM, ACROSS), UPRIGHT)
    nested: Any = ConstrainedGoal(AnyGoal((inner,)), UPRIGHT)  # type: ignore[arg-type]
    refused(planner, ask(nested), PlanCode.INVALID_GOAL_CONSTRAINTS, "path constraints within path constraints")


def test_search_that_nobody_wants_ends(planner):
    calls = 0

    def check_wanted() -> None:
        nonlocal calls
        calls += 1
        if calls > 100:
            raise PlanningError("cancelled", PlanCode.PREEMPTED)

    goal = ConstrainedGoal(JointGoal(ARM, ACROSS), UPRIGHT)
    refused(planner, ask(goal, check_wanted=check_wanted), PlanCode.PREEMPTED, "cancelled")


def test_constraints_need_the_joints_of_the_tool(planner):
    goal = ConstrainedGoal(JointGoal(("pan",), np.zeros(1)), UPRIGHT)
    request = PlanRequest(ARM[:3], DOWN[:3], goal, others={"flex": DOWN[3]})
    refused(planner, request, PlanCode.INVALID_GROUP_NAME, "not planned: flex, roll")


def test_motion_that_leaves_the_constraint_by_its_timing_is_refused(planner, monkeypatch):
    """The timing is checked, too: here it swings the wrist on its own."""

    def swinging(*arguments: Any, **options: Any) -> Motion:
        motion = timed(*arguments, **options)
        swing = np.zeros_like(motion.positions)
        swing[:, 3] = 0.6 * np.sin(np.pi * motion.times / motion.duration) ** 2
        return attrs.evolve(motion, positions=motion.positions + swing)

    monkeypatch.setattr("ibrobot_planning.planners.rrt.timed", swinging)
    monkeypatch.setattr("ibrobot_planning.planners.rrt._REPAIRS", 2)  # none of them helps
    message = (
        r"every timed motion breaks a path constraint; the last at 0\.\d{3} s, mostly by joint \w+: upright: the tool's"
        r" -z axis is 10\.\d\d degrees from the vertical, 10\.00 are allowed"
    )
    request = ask(ConstrainedGoal(JointGoal(ARM, ACROSS), UPRIGHT))
    refused(planner, request, PlanCode.INVALID_MOTION_PLAN, message)


def test_wall_that_nothing_upright_passes_is_named(tmp_path):
    planner = make_planner(tmp_path, WALL, planning_time=0.5)
    goal = ConstrainedGoal(JointGoal(ARM, ACROSS), PathConstraints(upright=TEN, region=(0, -0.4, 0, 0.4, 0.4, 0.2)))
    refused(planner, ask(goal), PlanCode.TIMED_OUT, "no path found within 0.5 s; on the straight way")


lengths = st.floats(-10, 10)
points = st.tuples(lengths, lengths, lengths)
axes = st.one_of(st.sampled_from(AXES), points.filter(any))
angles = st.floats(0.001, 3.0)


@st.composite
def constraints(draw: st.DrawFn) -> PathConstraints:
    """Any constraints."""
    which = draw(st.sets(st.sampled_from(["upright", "region", "view"]), min_size=1))
    values: dict[str, Any] = {}
    if "upright" in which:
        values |= {"upright": draw(angles), "upright_axis": draw(st.one_of(st.none(), axes))}
    if "region" in which:
        low, size = draw(points), draw(st.tuples(*[st.floats(0.001, 10)] * 3))
        values["region"] = (*low, *(a + b for a, b in zip(low, size, strict=True)))
    if "view" in which:
        values |= {"view": draw(points), "view_angle": draw(angles), "view_axis": draw(axes), "view_from": draw(points)}
    return PathConstraints(**values)


@given(given_=constraints())
def test_text_of_constraints_reads_back(robot, given_: PathConstraints):
    position = target(f"xyz=0.2,0,0.1 {given_.text}", robot).tool
    assert isinstance(position, ConstrainedGoal)
    assert (position.goal, position.constraints) == (PositionGoal(Vector3(0.2, 0.0, 0.1)), given_)
    for text, joints in ((f"pan=0.5,{given_.text}", {"pan": 0.5}), (f"{given_.text} pan=0.5", {"pan": 0.5})):
        read = target(text, robot)
        assert (read.tool, read.joints, read.constraints) == (None, joints, given_)
    named = target(f"left {given_.text}", robot)
    assert (named.joints, named.constraints) == (target("left", robot).joints, given_)


def test_typed_goals_equal_texts(robot):
    joints = JointGoal(("pan", "jaw"), np.array([0.5, 0.1]))
    typed, text = target(ConstrainedGoal(joints, UPRIGHT), robot), target(f"pan=0.5,jaw=0.1 {UPRIGHT.text}", robot)
    assert (typed.joints, typed.constraints) == (text.joints, text.constraints)
    assert target(ConstrainedGoal(NamedGoal("left"), UPRIGHT), robot).joints == target("left", robot).joints
    options = GoalOptions(xyz=(0.2, 0.0, 0.1), path_constraints=UPRIGHT).goal(World())
    assert isinstance(options, ConstrainedGoal)
    assert target(options, robot).tool is options
    assert target(options, robot).text == f"position 0.2, 0, 0.1 upright={TEN!r}"
    near = target(ConstrainedGoal(attrs.evolve(joints, tolerance=0.1), UPRIGHT), robot)
    assert isinstance(near.tool, ConstrainedGoal)
    assert near.constraints is None


def test_goals_know_whether_they_are_constrained():
    plain = PoseGoal(Pose())
    assert [constrains(each) for each in (None, plain, AnyGoal((plain,)))] == [False] * 3
    assert constrains(AnyGoal((plain, ConstrainedGoal(plain, UPRIGHT))))


AXIS = "x or y or z or -x or -y or -z or 3 numbers"


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ("upright=0.1", "upright holds on the way to a goal: give a pose's name, joints"),
        ("behind upright=0.1", "no pose 'behind'; the poses are: up, left, right"),
        ("left upright=0.1 jaw=0.2", "'left' is neither a joint nor xyz, axis"),
        ("left upright=", "upright takes 1 number, got 0"),
        ("left upright=0.1,0.2", "upright takes 1 number, got 2"),
        ("left upright=ten", "upright: 'ten' is not a finite number"),
        ("left upright=-0.1", "upright: -0.1 is too small, must be above 0 rad"),
        ("left upright=10", "upright: 10.0 is too large, must be below 3.14"),
        ("left upright=0.5 view=1,0,0 view_angle=-1", "view_angle: -1.0 is too small, must be above 0 rad"),
        ("left upright=0.1 upright=0.2", "upright is given twice"),
        ("left upright_axis=z", "upright_axis needs upright, the largest angle from the vertical"),
        ("left upright=0.1 upright_axis=up", f"upright_axis is {AXIS}, got 'up'"),
        ("left upright=0.1 upright_axis=0,1", "upright_axis takes 3 numbers, got 2"),
        ("left region=0,0,0,1,1", "region takes 6 numbers, got 5"),
        ("left region=0,0,0,1,0,1", "region: the lower y is 0, must be below the upper y, 0"),
        ("left view=0,0", "view takes 3 numbers, got 2"),
        ("left view=0,0,0 view_axis=ahead", f"view_axis is {AXIS}, got 'ahead'"),
        ("left view_angle=0.3", "view_angle needs view, the point to keep in view"),
        ("left view_angle=0.35", "path constraints have at least one of upright, region, view; there is none"),
    ],
)
def test_text_that_makes_no_sense(robot, goal: str, message: str):
    with pytest.raises(PlanningError) as failure:
        target(goal, robot)
    assert message in str(failure.value)
    assert failure.value.code is PlanCode.INVALID_GOAL_CONSTRAINTS


def test_waypoints_leave_constraints_to_their_line():
    line: Mapping[str, Any] = {"xyz": (0.2, 0.0, 0.1), "path_constraints": UPRIGHT}
    with pytest.raises(ValueError, match=r"waypoints\.0: path_constraints hold on the whole line: give them beside"):
        CartesianQuery(waypoints=(GoalOptions(**line),))


def test_way_out_of_a_contact_keeps_the_constraints(tmp_path):
    """It leaves the ball only where the tool leaves the region, too."""
    start = [0.25085444603, 0.35335509529, 1.40027860813, 0.20500151301, -0.89563274577]
    goal = [-0.40575787931, 0.29684632524, 1.59390914113, 0.28832776768, -1.15110409759]
    region = (0.23438633664, -0.10106412986, 0.12248742046, 0.2701149042, 0.07227773732, 0.15813899433)
    ball = WorldObject(Sphere(0.02), Pose(Vector3(0.17380923337, 0.0569797767, 0.16983318834)))
    planner = make_planner(tmp_path, World({"ball": ball}))
    request = ask(ConstrainedGoal(JointGoal(ARM, np.array(goal)), PathConstraints(region=region)), np.array(start))
    message = (
        "the start is in collision, and no short motion leads out within the path constraints: wrist overlaps ball"
    )
    refused(planner, request, PlanCode.START_STATE_IN_COLLISION, message)
