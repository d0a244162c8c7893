"""SRDFs: written from samples, and read by the planner."""

from __future__ import annotations

import logging

import attrs
import numpy as np
import pytest
from ibrobot_kinematics.srdf import GroupState, read_srdf
from ibrobot_kinematics.urdf import read_urdf
from ibrobot_planning.commands.description import srdf_of as srdf
from ibrobot_planning.goals.grammar import named_pose, pose_names, target
from ibrobot_planning.planner import NamedGoal, PlanRequest
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.tasks.format import MoveStep
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.checked_arm import urdf_names
from ibrobot_planning.world.collision import unchecked_pairs
from ibrobot_planning.world.objects import World

from ibrobot_core.api import Context, PlanningError, SteppedClock

from .table_arm import ARM, make_robot

CARRIED = {
    "pan": "turret_link",
    "lift": "upper_link",
    "elbow": "lower_link",
    "flex": "wrist_link",
    "roll": "hand_link",
    "jaw": "finger_link",
}


@pytest.fixture
def described(tmp_path):
    """The robot with a URDF whose links have names of their own."""
    parents = ["foot_link", *CARRIED.values()]
    parents[6] = "hand_link"
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        '<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="3" effort="1"/></joint>'
        for (name, child), parent in zip(CARRIED.items(), ["foot_link", *list(CARRIED.values())[:5]], strict=True)
    )
    links = "".join(f'<link name="{name}"/>' for name in ("foot_link", *CARRIED.values()))
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="tabletop">{links}{joints}</robot>')
    robot = make_robot(tmp_path)
    return attrs.evolve(robot, description=attrs.evolve(robot.description, urdf=path))


def test_links_have_the_names_of_the_urdf(described):
    names = urdf_names(robot_arm(described), read_urdf(described.description.urdf))
    assert names == {
        "base": "foot_link",
        "turret": "turret_link",
        "upper": "upper_link",
        "lower": "lower_link",
        "wrist": "wrist_link",
        "hand": "hand_link",
        "finger": "finger_link",
    }


def test_a_written_srdf_is_read_with_groups_poses_and_pairs(described, tmp_path):
    arm, urdf = robot_arm(described), read_urdf(described.description.urdf)
    pairs = unchecked_pairs(arm, samples=2000, never=True)
    path = tmp_path / "arm.srdf"
    path.write_text(srdf(described, pairs, urdf_names(arm, urdf)))
    found = read_srdf(path, urdf)
    assert found.groups["arm"] == ARM
    assert GroupState("left", "arm", {"pan": 1.0, "lift": 0.8, "elbow": 0.8, "flex": 0.5, "roll": 0.0}) in found.states
    assert ("foot_link", "turret_link") in found.may_touch
    assert len(found.may_touch) == len(pairs)
    assert "Never" in path.read_text()


def test_the_planner_takes_pairs_and_poses_of_an_srdf(described, tmp_path, caplog):
    path = tmp_path / "arm.srdf"
    path.write_text(
        '<robot name="tabletop"><group name="arm"><joint name="pan"/></group>'
        '<group_state name="aside" group="arm"><joint name="pan" value="0.7"/></group_state>'
        '<disable_collisions link1="foot_link" link2="hand_link" reason="User"/></robot>'
    )
    robot = attrs.evolve(described, description=attrs.evolve(described.description, srdf=path))
    planner = RrtConnectPlanner(RrtConnectOptions(), Context("p", SteppedClock(0), logging.getLogger("test"), robot))
    planner.load()
    assert caplog.messages == []
    result = planner.plan(PlanRequest(ARM, np.zeros(5), NamedGoal("aside")))
    np.testing.assert_allclose(result.trajectory.points[-1].positions, [0.7, 0, 0, 0, 0], atol=1e-9)


def with_states(robot, path, *states: str):
    """The robot with an SRDF of two groups, and these group states."""
    groups = (
        '<group name="arm"><joint name="pan"/><joint name="lift"/></group><group name="g"><joint name="jaw"/></group>'
    )
    path.write_text(f'<robot name="tabletop">{groups}{"".join(states)}</robot>')
    return attrs.evolve(robot, description=attrs.evolve(robot.description, srdf=path))


def state(name: str, group: str, **joints: float) -> str:
    inner = "".join(f'<joint name="{joint}" value="{value}"/>' for joint, value in joints.items())
    return f'<group_state name="{name}" group="{group}">{inner}</group_state>'


PAN = state("aside", "arm", pan=0.7, lift=0.1)
JAW = state("aside", "g", jaw=0.3)
AGAIN = state("home", "arm", pan=0.2, lift=0.0)


def test_group_states_of_all_groups_are_one_pose(described, tmp_path):
    robot = with_states(described, tmp_path / "arm.srdf", PAN, JAW, AGAIN)
    assert pose_names(robot) == ["up", "left", "right", "aside", "home"]
    assert named_pose(robot, "aside") == {"pan": 0.7, "lift": 0.1, "jaw": 0.3}
    assert target("aside", robot).joints == named_pose(robot, "aside")
    assert named_pose(robot, "left")["pan"] == 1.0
    with pytest.raises(PlanningError, match="no pose 'asid'; the poses are: up, left, right, aside, home"):
        named_pose(robot, "asid")


def test_group_state_is_a_goal_of_a_step_with_the_joints_of_the_arm(described, tmp_path):
    robot = with_states(described, tmp_path / "arm.srdf", PAN, JAW)
    assert MoveStep(pose="aside").target(robot, ARM, World()).joints == {"pan": 0.7, "lift": 0.1}


def test_group_states_that_contradict_each_other_are_named(described, tmp_path):
    path = tmp_path / "arm.srdf"
    robot = with_states(described, path, PAN, JAW)
    path.write_text(
        path.read_text()
        .replace('<joint name="jaw"/></group>', '<joint name="jaw"/><joint name="pan"/></group>')
        .replace('value="0.3"/>', 'value="0.3"/><joint name="pan" value="0"/>')
    )
    with pytest.raises(PlanningError, match="'aside' of the SRDF has two positions of joint pan, in groups arm, g"):
        named_pose(robot, "aside")
