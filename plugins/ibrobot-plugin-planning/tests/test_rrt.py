"""The planner around obstacles: goals of all kinds, codes, sentences, and motions checked by MuJoCo's distances."""

from __future__ import annotations

import math
from typing import override

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_kinematics import robot_model
from ibrobot_planning.goals.tool import Tool
from ibrobot_planning.planner import (
    AnyGoal,
    JointGoal,
    LinearGoal,
    NamedGoal,
    Planner,
    PlanRequest,
    PlanResult,
    PoseGoal,
    PositionGoal,
)
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.planners.timing import Motion
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import Sphere, World, WorldObject

from ibrobot_core.api import PlanCode, PlanningError, Pose, Quaternion, Robot, Vector3

from .table_arm import ARM, WALL, box, make_planner, make_robot, write_arm

LEFT, RIGHT = np.array([1.0, 0.8, 0.8, 0.5, 0.0]), np.array([-1.0, 0.8, 0.8, 0.5, 0.0])
DOWN = Vector3(0, 0, -1)


@pytest.fixture(scope="module")
def planner(tmp_path_factory) -> RrtConnectPlanner:
    """With the wall; tests that need another world make a planner of their own."""
    return make_planner(tmp_path_factory.mktemp("planner"), WALL)


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Robot:
    return make_robot(tmp_path_factory.mktemp("robot"))


def ask(goal, start=LEFT, **changes) -> PlanRequest:
    return PlanRequest(ARM, np.array(start, dtype=float), goal, **changes)


def motion(result: PlanResult) -> Motion:
    points = result.trajectory.points
    times = np.array([point.time_from_start_ns for point in points]) / 1e9
    states = np.array([(point.positions, point.velocities, point.accelerations) for point in points])
    return Motion(times, *states.swapaxes(0, 1))


def tip(planner: RrtConnectPlanner, q) -> np.ndarray:
    """Pose of the tip, shape (4, 4)."""
    placed = planner.arm.link_pose("hand", np.append(q, 0.0))
    placed[:3, 3] += 0.06 * placed[:3, 2]
    return placed


def end(planner: RrtConnectPlanner, result: PlanResult) -> np.ndarray:
    return tip(planner, result.trajectory.points[-1].positions)


def refused(planner: RrtConnectPlanner, request: PlanRequest, code: PlanCode, message: str) -> None:
    with pytest.raises(PlanningError, match=message) as caught:
        planner.plan(request)
    assert caught.value.code is code


@pytest.mark.parametrize("seed", range(3))
def test_the_way_leads_around_the_wall_with_padding_and_within_limits(tmp_path, seed):
    planner = make_planner(tmp_path, WALL, seed, padding=0.01)
    planned = motion(planner.plan(ask(JointGoal(ARM, RIGHT))))
    np.testing.assert_allclose(planned.positions[[0, -1]], [LEFT, RIGHT], atol=1e-9)
    wall = '<geom name="wall" type="box" pos=".2 0 .15" size=".15 .01 .15"/>'
    model = mujoco.MjModel.from_xml_path(str(write_arm(tmp_path, wall)))
    data = mujoco.MjData(model)
    links = [i for i in range(model.ngeom) if model.geom_contype[i] and model.geom(i).name != "wall"]
    positions, velocities, accelerations = planned.sampled(0.001)
    least = np.inf
    for q in positions[::5]:
        data.qpos[:5] = q
        mujoco.mj_kinematics(model, data)
        least = min(least, *(mujoco.mj_geomDistance(model, data, i, model.geom("wall").id, 1.0, None) for i in links))
    assert 0.0099 < least < 0.1
    assert np.abs(velocities).max() <= 3.0
    assert np.abs(accelerations).max() <= 10.0
    assert planned.jerk <= 400.0


def test_equal_seeds_give_equal_trajectories(tmp_path, planner):
    request = ask(JointGoal(ARM, RIGHT))
    again = make_planner(tmp_path, WALL).plan(request)
    np.testing.assert_array_equal(motion(planner.plan(request)).positions, motion(again).positions)


def test_named_poses_are_goals(planner):
    np.testing.assert_allclose(planner.plan(ask(NamedGoal("right"))).trajectory.points[-1].positions, RIGHT, atol=1e-9)
    message = "no pose 'behind'; the poses are: up, left, right"
    refused(planner, ask(NamedGoal("behind")), PlanCode.INVALID_GOAL_CONSTRAINTS, message)


def test_positions_are_goals(planner):
    result = planner.plan(ask(PositionGoal(Vector3(0.2, -0.15, 0.1))))
    np.testing.assert_allclose(end(planner, result)[:3, 3], [0.2, -0.15, 0.1], atol=1e-3)
    assert result.position_error < 1e-3


def test_positions_with_the_direction_of_the_tool_are_goals(planner):
    result = planner.plan(ask(PositionGoal(Vector3(0.15, -0.15, 0.06), axis=DOWN)))
    reached = end(planner, result)
    np.testing.assert_allclose(reached[:3, 3], [0.15, -0.15, 0.06], atol=1e-3)
    np.testing.assert_allclose(reached[:3, 2], [0, 0, -1], atol=0.01)


REACHABLE = np.array([-0.9, 0.9, 0.9, 0.7, 0.4])


def pose_of(planner: RrtConnectPlanner, q, turn: float = 0.0) -> Pose:
    """The pose of the tip at `q`, turned about the world's z axis."""
    from ibrobot_kinematics.poses import pose

    placed = tip(planner, q)
    c, s = math.cos(turn), math.sin(turn)
    placed[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ placed[:3, :3]
    return pose(placed)


def test_poses_that_the_arm_can_take_are_goals(planner):
    result = planner.plan(ask(PoseGoal(pose_of(planner, REACHABLE))))
    np.testing.assert_allclose(end(planner, result), tip(planner, REACHABLE), atol=0.01)
    assert result.orientation_error < 0.01


def test_what_five_joints_cannot_do_is_the_callers_choice(planner, robot):
    beyond = PoseGoal(pose_of(planner, REACHABLE, 0.5))
    message = r"tip cannot take this orientation at .* m; the nearest found is \d+\.\d degrees off"
    refused(planner, ask(beyond), PlanCode.NO_IK_SOLUTION, message)
    # The policies differ in where the arm ends; one plan shows that it gets there.
    tool, start = Tool(robot_model(robot)), np.append(LEFT, 0.0)
    errors = {}
    for policy in ("nearest", "arm_plane", "current", "free"):
        reached = tool.candidates(attrs.evolve(beyond, beyond_reach=policy), start)[0]
        assert reached.position_error < 1e-3
        errors[policy] = reached.orientation_error
    result = planner.plan(ask(attrs.evolve(beyond, beyond_reach="nearest")))
    assert result.orientation_error == pytest.approx(errors["nearest"])
    keeping = attrs.evolve(beyond, beyond_reach="keep_axis")
    refused(planner, ask(keeping), PlanCode.NO_IK_SOLUTION, "tip cannot reach .* 0.0 mm and .* degrees off")
    assert 0.01 < errors["nearest"] <= min(errors.values()) + 1e-6


def test_the_first_alternative_that_can_be_reached_is_taken(planner):
    far, inside = PositionGoal(Vector3(1.0, 0, 0.1)), JointGoal(ARM, LEFT * [0, 1, 1, 1, 1])
    result = planner.plan(ask(AnyGoal((far, inside, JointGoal(ARM, RIGHT), NamedGoal("up")))))
    assert result.alternative == 2
    np.testing.assert_allclose(result.trajectory.points[-1].positions, RIGHT, atol=1e-9)
    message = "no alternative of the goal can be reached: alternative 0: tip cannot reach .*; alternative 1: .*wall"
    refused(planner, ask(AnyGoal((far, inside))), PlanCode.NO_IK_SOLUTION, message)


def test_joint_goals_with_a_tolerance_end_beside_what_is_blocked(tmp_path):
    planner = make_planner(tmp_path, World({"ball": box(0.0, 0, 0.478, 0.02, 0.02, 0.02)}))
    refused(planner, ask(JointGoal(ARM, np.zeros(5))), PlanCode.GOAL_IN_COLLISION, "the goal is in collision: .* ball")
    result = planner.plan(ask(JointGoal(ARM, np.zeros(5), tolerance=0.3)))
    assert 0 < np.abs(result.trajectory.points[-1].positions).max() <= 0.3


def test_straight_lines_are_followed(planner):
    start = np.array([1.0, 0.6, 1.4, 1.0, 0.0])
    begin = tip(planner, start)[:3, 3]
    over = begin + np.array([0.03, 0.05, 0.0])
    down = over - np.array([0.0, 0.0, 0.03])
    goal = LinearGoal((PositionGoal(Vector3(*over)), PositionGoal(Vector3(*down))))
    result = planner.plan(ask(goal, start))
    assert result.fraction == 1
    np.testing.assert_allclose(end(planner, result)[:3, 3], down, atol=1e-3)
    for q in motion(result).sampled(0.005)[0]:
        place = tip(planner, q)[:3, 3]
        off = []
        for a, b in ((begin, over), (over, down)):
            share = np.clip((place - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            off.append(np.linalg.norm(place - a - share * (b - a)))
        assert min(off) < 1e-3


def test_straight_lines_end_where_something_is_in_the_way(planner):
    begin = tip(planner, LEFT)[:3, 3]
    through = PositionGoal(Vector3(begin[0], -begin[1], begin[2]))
    refused(
        planner,
        ask(LinearGoal((through,))),
        PlanCode.PLANNING_FAILED,
        r"the tool can follow \d\d % of the straight path, 100 % asked: \w+ .* wall",
    )
    result = planner.plan(ask(LinearGoal((through,), least_fraction=0.1)))
    assert 0.1 < result.fraction < 0.5
    assert end(planner, result)[1, 3] > 0.015


def test_straight_lines_end_where_the_reach_does(planner):
    message = "the tool can follow .* % of the straight path, 100 % asked: tip cannot reach"
    goal = LinearGoal((PositionGoal(Vector3(*(3 * tip(planner, LEFT)[:3, 3]))),))
    refused(planner, ask(goal), PlanCode.PLANNING_FAILED, message)


def test_a_start_in_contact_leaves_outwards(tmp_path):
    planner = make_planner(tmp_path)
    hand = planner.arm.link_pose("hand", np.append(LEFT, 0.0))
    # 3 mm into the outer side of the hand.
    beside = hand[:3, 3] + hand[:3, :3] @ [-0.016 - 0.015 + 0.003, 0, 0.03]
    ball = WorldObject(Sphere(0.015), Pose(Vector3(*beside)))
    planner.world = World({"ball": ball})
    checks = Collisions(planner.arm, planner.world, ARM, padding=0.005)
    positions = motion(planner.plan(ask(NamedGoal("up")))).sampled(0.001)[0]
    depth = [checks.contacts(q)[0].distance if not checks.free(q) else 0.005 for q in positions[:200]]
    assert depth[0] == pytest.approx(-0.003, abs=2e-4)
    assert min(depth) > depth[0] - 2e-4
    planner.world = World({"ball": attrs.evolve(ball, shape=Sphere(0.04))})
    refused(
        planner,
        ask(NamedGoal("up")),
        PlanCode.START_STATE_IN_COLLISION,
        "the start is in collision: .* overlaps ball by",
    )


def test_a_start_outside_limits_moves_inwards_only(planner):
    start = LEFT + np.array([1.05, 0, 0, 0, 0])
    positions = motion(planner.plan(ask(JointGoal(ARM, LEFT), start))).sampled(0.001)[0]
    np.testing.assert_allclose(positions[0], start)
    assert positions[:, 0].max() <= 2.05 + 1e-6
    message = "start of joint pan is 2.2000 rad, 0.2000 rad outside its limits"
    refused(planner, ask(NamedGoal("up"), start + 0.15 * np.eye(5)[0]), PlanCode.START_STATE_INVALID, message)


def test_a_search_that_finds_nothing_says_what_is_in_the_way(tmp_path):
    planner = make_planner(tmp_path, WALL, planning_time=1e-6)
    message = r"no path found within 1e-06 s; on the straight way \w+ (overlaps|is .* from) wall"
    refused(planner, ask(JointGoal(ARM, RIGHT)), PlanCode.TIMED_OUT, message)


MALFORMED = {
    "unknown joint": (
        ask(JointGoal(("knee",), np.zeros(1))), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "no joint 'knee'; the joints are: pan",
    ),
    "joint that is not planned": (
        ask(JointGoal(("jaw",), np.zeros(1))), PlanCode.INVALID_GOAL_CONSTRAINTS, "'jaw', which is not planned",
    ),
    "joint twice": (ask(JointGoal(("pan", "pan"), np.zeros(2))), PlanCode.INVALID_GOAL_CONSTRAINTS, "'pan' twice"),
    "another number of positions": (
        ask(JointGoal(ARM, np.zeros(4))), PlanCode.INVALID_GOAL_CONSTRAINTS, r"of shape \(4,\), must be \(5,\)",
    ),
    "position that is nan": (
        ask(JointGoal(("pan",), np.array([np.nan]))), PlanCode.INVALID_GOAL_CONSTRAINTS, "joint pan is nan rad",
    ),
    "position outside limits": (
        ask(JointGoal(("pan",), np.array([3.0]))), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "goal of joint pan is 3.0 rad, must be within -2.0 .. 2.0 rad",
    ),
    "negative tolerance": (
        ask(JointGoal(ARM, LEFT, tolerance=-1)), PlanCode.INVALID_GOAL_CONSTRAINTS, "a tolerance of -1 rad",
    ),
    "place that is nan": (
        ask(PositionGoal(Vector3(math.nan, 0, 0))), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "the position of the goal is .nan",
    ),
    "place out of reach": (
        ask(PositionGoal(Vector3(0.9, 0, 0.1))), PlanCode.NO_IK_SOLUTION,
        r"tip cannot reach \(0.900, 0.000, 0.100\) m .*; the nearest is .* 520.1 mm off",
    ),
    "axis without length": (
        ask(PositionGoal(Vector3(0.2, 0.1, 0.1), axis=Vector3())), PlanCode.INVALID_GOAL_CONSTRAINTS,
        r"the axis of the goal has no length; give a direction, e.g. \(0, 0, -1\) for down",
    ),
    "no position tolerance": (
        ask(PositionGoal(Vector3(0.2, 0.1, 0.1), position_tolerance=0)), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "position_tolerance of the goal is 0, must be above 0",
    ),
    "quaternion of another length": (
        ask(PoseGoal(Pose(Vector3(0.2, 0.1, 0.1), Quaternion(0, 0, 0, 2)))), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "the orientation of the goal is a quaternion of length 2, must be 1",
    ),
    "quaternion that is nan": (
        ask(PoseGoal(Pose(Vector3(0.2, 0.1, 0.1), Quaternion(0, 0, 0, math.nan)))), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "a quaternion of length nan",
    ),
    "no alternatives": (ask(AnyGoal(())), PlanCode.INVALID_GOAL_CONSTRAINTS, "the goal has no alternatives"),
    "no waypoints": (ask(LinearGoal(())), PlanCode.INVALID_GOAL_CONSTRAINTS, "at least one waypoint"),
    "no fraction": (
        ask(LinearGoal((PositionGoal(Vector3()),), least_fraction=0)), PlanCode.INVALID_GOAL_CONSTRAINTS,
        "least_fraction is 0, must be above 0 and at most 1",
    ),
    "waypoint that is nan": (
        ask(LinearGoal((PositionGoal(Vector3(math.nan, 0, 0)),))), PlanCode.INVALID_GOAL_CONSTRAINTS, "must be finite",
    ),
    "goal of another kind": (ask("home"), PlanCode.UNRECOGNIZED_GOAL_TYPE, "of type str is not known; known are"),
    "start of another shape": (
        ask(NamedGoal("up"), np.zeros(3)), PlanCode.INVALID_ROBOT_STATE, r"start has shape \(3,\), must be \(5,\)",
    ),
    "start that is nan": (
        ask(NamedGoal("up"), np.full(5, np.nan)), PlanCode.INVALID_ROBOT_STATE,
        "start of joint pan is nan, must be finite",
    ),
    "unknown planned joint": (
        PlanRequest(("knee",), np.zeros(1), NamedGoal("up")), PlanCode.INVALID_GROUP_NAME, "no joint 'knee'",
    ),
    "tool without all of its joints": (
        PlanRequest(ARM[:3], np.zeros(3), PositionGoal(Vector3(0.2, 0.1, 0.1))), PlanCode.INVALID_GROUP_NAME,
        "a goal of the tool needs all joints that move it; not planned: flex, roll",
    ),
    "speed of nothing": (
        ask(NamedGoal("up"), velocity_scaling=0), PlanCode.PLANNING_FAILED, "velocity_scaling is 0, must be from 0.01",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("request_", "code", "message"), MALFORMED.values(), ids=MALFORMED)
def test_goals_that_cannot_be_meant_are_refused(planner, request_, code, message):
    refused(planner, request_, code, message)


def test_scalings_slow_down(planner):
    slow = motion(planner.plan(ask(JointGoal(ARM, RIGHT), velocity_scaling=0.2, acceleration_scaling=0.1)))
    _, velocities, accelerations = slow.sampled(0.001)
    assert np.abs(velocities).max() <= 0.6
    assert np.abs(accelerations).max() <= 1.0


class Graph(Planner):
    """Another planner's view of the interface: it knows no straight lines, and tries alternatives by itself."""

    def __init__(self, other: Planner) -> None:
        self._other = other

    @override
    def plan(self, request: PlanRequest) -> PlanResult:
        if isinstance(request.goal, LinearGoal):
            raise PlanningError("straight lines are not known", PlanCode.UNRECOGNIZED_GOAL_TYPE)
        goals = request.goal.goals if isinstance(request.goal, AnyGoal) else (request.goal,)
        for number, goal in enumerate(goals):
            try:
                found = self._other.plan(attrs.evolve(request, goal=goal))
            except PlanningError:
                continue
            return attrs.evolve(found, alternative=number)
        raise PlanningError("no goal is reached", PlanCode.NO_IK_SOLUTION)


def test_other_planners_fit_the_interface(planner):
    result = Graph(planner).plan(ask(AnyGoal((PositionGoal(Vector3(1, 0, 0)), NamedGoal("right")))))
    assert result.alternative == 1


def test_floor_blocks_everything_below(tmp_path):
    low = JointGoal(ARM, np.array([0.0, 1.6, 0.5, 0.5, 0.0]))
    request = PlanRequest(ARM, np.zeros(5), low)
    make_planner(tmp_path).plan(request)
    planner = make_planner(tmp_path, floor=0.0)
    with pytest.raises(PlanningError, match=r"the goal is in collision: \w+ overlaps floor by") as failure:
        planner.plan(request)
    assert failure.value.code is PlanCode.GOAL_IN_COLLISION
    planner.plan(PlanRequest(ARM, np.zeros(5), NamedGoal("left")))
