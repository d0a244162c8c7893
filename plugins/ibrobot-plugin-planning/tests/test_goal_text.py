"""Goals as text and as values: what they mean, and what is said of those that make no sense."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ibrobot_planning.goals.grammar import target
from ibrobot_planning.planner import AnyGoal, JointGoal, NamedGoal, PoseGoal, PositionGoal

from ibrobot_core.api import PlanCode, PlanningError, Quaternion, Vector3

from .table_arm import JOINTS, make_robot


@pytest.fixture
def robot(tmp_path):
    return make_robot(tmp_path)


def test_pose_by_name(robot):
    assert target("left", robot).joints == dict(zip(JOINTS, (1.0, 0.8, 0.8, 0.5, 0.0, 0.0), strict=True))
    assert target(NamedGoal("left"), robot) == target("left", robot)


def test_joints(robot):
    assert target("pan=0.5, jaw=-0.1", robot).joints == {"pan": 0.5, "jaw": -0.1}
    assert target(JointGoal(("pan",), np.array([0.5])), robot).joints == {"pan": 0.5}


def test_position_alone_with_an_axis_and_with_the_gripper(robot):
    assert target("xyz=0.2,0,0.1", robot).tool == PositionGoal(Vector3(0.2, 0.0, 0.1))
    down = PositionGoal(Vector3(0.2, 0.0, 0.1), Vector3(0.0, 0.0, -1.0))
    assert target("xyz=0.2,0,0.1 axis=down", robot).tool == down
    parsed = target("xyz=0.2, 0, 0.1, axis=0,0,-1, jaw=0.4", robot)
    assert (parsed.tool, parsed.joints) == (down, {"jaw": 0.4})


def test_pose_by_angles_and_by_a_quaternion(robot):
    turned = target("xyz=0.2,0,0.1 rpy=0,0,3.141592653589793 beyond_reach=nearest", robot).tool
    assert isinstance(turned, PoseGoal)
    assert turned.beyond_reach == "nearest"
    q = turned.pose.orientation
    assert (q.x, q.y, q.z, q.w) == pytest.approx((0, 0, 1, 0), abs=1e-9)
    goal = target("xyz=0.2,0,0.1 quaternion=0,0,0,1", robot).tool
    assert isinstance(goal, PoseGoal)
    assert (goal.pose.orientation, goal.beyond_reach) == (Quaternion(), "refuse")


def test_value_of_another_kind_goes_to_the_planner_as_it_is(robot):
    goal = AnyGoal((PositionGoal(Vector3(0.2, 0.0, 0.1)),))
    assert target(goal, robot, 0.5).tool is goal
    assert target(goal, robot, 0.5).velocity_scaling == 0.5


POSES = "the poses are: up, left, right; or give joints, e.g. wrist_flex=0.5, or a position, e.g. xyz=0.2,0.0,0.1"
NAMES = ", ".join(JOINTS)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ("", "a goal is a pose's name, joints, e.g. wrist_flex=0.5, or a position, e.g. xyz=0.2,0.0,0.1"),
        ("lft", f"no pose 'lft'; {POSES}"),
        ("tilt=1", f"no joint 'tilt'; the joints are: {NAMES}"),
        ("pan=wide", "'wide' is not an angle in radians"),
        ("pan=inf", "'inf' is not an angle in radians"),
        ("pan=", "joint pan takes one angle, got 0"),
        ("pan=1,2", "joint pan takes one angle, got 2"),
        ("pan=1,pan=2", "pan is given twice"),
        (
            "0.5 pan=1",
            "'0.5' is neither a joint nor xyz, axis, rpy, quaternion, upright, upright_axis, region, view, view_angle,"
            " view_axis, view_from, beyond_reach, each followed by = and its value",
        ),
        ("xyz=0.2,0.1", "xyz takes 3 numbers, got 2"),
        ("xyz=0.2,0.1,high", "xyz: 'high' is not a finite number"),
        ("xyz=0.2,0.1,nan", "xyz: 'nan' is not a finite number"),
        ("axis=down", "axis needs a position, e.g. xyz=0.2,0.0,0.1"),
        ("rpy=0,0,0", "rpy needs a position, e.g. xyz=0.2,0.0,0.1"),
        ("xyz=0,0,1 axis=left", "axis is down or up or 3 numbers, got 'left'"),
        ("xyz=0,0,1 axis=0,0,0", "axis has no length; give a direction, e.g. down, or 0, 0, -1"),
        ("xyz=0,0,1 axis=0,1", "axis takes 3 numbers, got 2"),
        ("xyz=0,0,1 rpy=0,1", "rpy takes 3 numbers, got 2"),
        ("xyz=0,0,1 quat=0,0,0,1", "quat is called quaternion"),
        ("xyz=0,0,1 quaternion=0,0,1", "quaternion takes 4 numbers, got 3"),
        ("xyz=0,0,1 quaternion=0,0,0,2", "quaternion has length 2, must be 1; the order is x, y, z, w"),
        ("xyz=0,0,1 axis=down rpy=0,0,0", "axis and rpy exclude each other"),
        ("xyz=0,0,1 beyond_reach=nearest", "beyond_reach needs an orientation: rpy or quaternion"),
        (
            "xyz=0,0,1 rpy=0,0,0 beyond_reach=near",
            "beyond_reach is one of refuse, nearest, keep_axis, arm_plane, current, free; got 'near'",
        ),
    ],
)
def test_text_that_makes_no_sense(robot, goal: str, message: str):
    with pytest.raises(PlanningError) as failure:
        target(goal, robot)
    assert str(failure.value) == f"goal {goal!r}: {message}"
    assert failure.value.code is PlanCode.INVALID_GOAL_CONSTRAINTS


@pytest.mark.parametrize(
    ("goal", "scaling", "message"),
    [
        (5, 1.0, "a goal is a text such as 'home' or 'xyz=0.2,0.0,0.1', or a goal of ibrobot_core.api; got int"),
        (
            JointGoal(("pan",), np.zeros(2)),
            1.0,
            "goal has joints: 1, positions: 2; must have each joint once, with a position",
        ),
        (
            JointGoal(("pan", "pan"), np.zeros(2)),
            1.0,
            "goal has joints: 2, positions: 2; must have each joint once, with a position",
        ),
        (JointGoal(("tilt",), np.zeros(1)), 1.0, f"no joint 'tilt'; the joints are: {NAMES}"),
        (
            JointGoal(("pan",), np.array([math.nan])),
            1.0,
            "goal of joint pan is nan, must be an angle in radians",
        ),
        ("up", 0.0, "velocity_scaling is 0.0, must be from 0.01 to 1"),
        ("up", math.nan, "velocity_scaling is nan, must be from 0.01 to 1"),
    ],
)
def test_value_that_makes_no_sense(robot, goal, scaling: float, message: str):
    with pytest.raises(PlanningError) as failure:
        target(goal, robot, scaling)
    assert str(failure.value) == message
