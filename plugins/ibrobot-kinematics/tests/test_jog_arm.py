"""What jog devices have in common: setpoints from velocities, and how they follow a robot that does not."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_kinematics import JogArm, JogMotion, VelocityJog
from ibrobot_testing import make_robot

from ibrobot_core.api import Description, Joint, JointReading, Robot, TeleopError, Vector, ns

from .arms import BENT, FIVE, write_arm

DT = 0.01
STILL = np.zeros(6)


def arm_of(directory: Path) -> JogArm:
    joints = tuple(Joint(name, -1.6, 1.6, max_velocity=3.0, max_acceleration=20.0) for name in FIVE)
    description = Description(mjcf=write_arm(directory, *FIVE), tip="tool")
    arm = JogArm(Robot("five", joints, groups={"gripper": ("gripper",)}, description=description), "gripper")
    arm.load_model("tool: false", None)
    return arm


def one(joint: int, velocity: float) -> JogMotion:
    motion = STILL.copy()
    motion[joint] = velocity
    return JogMotion(motion)


def test_joints_that_are_not_the_grippers_are_the_arms():
    arm = JogArm(make_robot(), "gripper")
    assert (arm.arm[-1], arm.gripper) == ("wrist_roll", ("gripper",))
    assert JogArm(make_robot(), "hand").gripper == ()


def test_tool_needs_a_model():
    arm = JogArm(make_robot(), "gripper")
    with pytest.raises(TeleopError, match=r"needs robot\.description\.mjcf: set it, or tool: false$"):
        arm.load_model("tool: false", None)
    with pytest.raises(TeleopError, match="call load_model before move_tool"):
        arm.move_tool(STILL, np.ones(3), np.zeros(3), DT)


def test_a_pose_is_reached_in_step_and_not_passed():
    arm, pose = JogArm(make_robot(), "gripper"), np.array([0.1, -0.2, 0.3, 0.0, 0.4, 0.5])
    halfway = arm.move_towards(STILL, pose, 0.5, 0.5)
    np.testing.assert_allclose(halfway, pose / 2)
    np.testing.assert_array_equal(arm.move_towards(STILL, pose, 0.5, 10.0), pose)


@given(
    st.lists(st.floats(-5, 5), min_size=6, max_size=6).map(np.array),
    st.lists(st.lists(st.floats(-9, 9), min_size=6, max_size=6).map(np.array), max_size=20),
)
def test_no_setpoint_leaves_its_bounds(measured: Vector, velocities: list[Vector]):
    arm = JogArm(make_robot(), "gripper")
    robot, jog = arm.robot, VelocityJog(arm, 0.1)
    for velocity in velocities:
        setpoint = jog.move(measured, JogMotion(velocity), DT)
        assert np.all(np.abs(setpoint - measured) <= robot.max_lead + 1e-12)
        assert np.all(setpoint >= np.minimum(robot.lower, measured) - 1e-12)
        assert np.all(setpoint <= np.maximum(robot.upper, measured) + 1e-12)


def test_velocity_is_integrated_while_the_robot_follows():
    jog, at = VelocityJog(JogArm(make_robot(), "gripper"), 0.1), STILL
    for _ in range(50):
        at = jog.move(at, one(1, 0.5), DT)
    assert at[1] == pytest.approx(0.25)


def test_a_blocked_joint_leads_no_further_than_it_may_and_reverses_at_once():
    arm = JogArm(make_robot(), "gripper")
    jog = VelocityJog(arm, 0.1)
    for _ in range(200):
        setpoint = jog.move(STILL, one(1, 1.0), DT)
    assert setpoint[1] == pytest.approx(arm.robot.max_lead[1])
    jog.move(STILL, JogMotion(STILL), DT)  # the stick passes its rest
    assert jog.move(STILL, one(1, -1.0), DT)[1] == pytest.approx(-DT)


def test_a_joint_at_rest_sags_a_little_and_follows_a_push():
    jog = VelocityJog(JogArm(make_robot(), "gripper"), 0.1)
    jog.restart(STILL)
    rest = JogMotion(STILL)
    sagged, pushed = STILL.copy(), STILL.copy()
    sagged[1], pushed[1] = -0.08, 0.7
    assert jog.move(sagged, rest, DT)[1] == 0.0, "it does not creep"
    assert jog.move(pushed, rest, DT)[1] == pytest.approx(0.6)


def test_tool_waits_where_a_joint_does_not_follow_and_reverses_at_once(tmp_path):
    arm = arm_of(tmp_path)
    jog, at = VelocityJog(arm, 0.1), np.array([BENT[name] for name in FIVE])
    forward = JogMotion(STILL, np.array([0.1, 0.0, 0.0]))
    path = [jog.move(at, forward, DT) for _ in range(400)]
    np.testing.assert_array_equal(path[-1], path[-2])
    assert np.all(np.abs(path[-1] - at) <= arm.robot.max_lead + 1e-12)
    back = jog.move(at, attrs.evolve(forward, linear=-forward.linear), DT)
    assert np.max(np.abs(back - at)) < 0.02


def test_a_restart_forgets_the_lead():
    jog = VelocityJog(JogArm(make_robot(), "gripper"), 0.1)
    for _ in range(20):
        jog.move(STILL, one(0, 1.0), DT)
    jog.restart(STILL)
    np.testing.assert_array_equal(jog.move(STILL, JogMotion(STILL), DT), STILL)


def test_a_step_from_rest_begins_where_the_robot_is_and_a_pause_is_no_long_step():
    jog, there = VelocityJog(JogArm(make_robot(), "gripper"), 0.1), np.full(6, 0.2)
    steps = [jog.step(JointReading(ns(at_s), there, STILL, STILL)) for at_s in (1.0, 1.02, 0.9, 5.0)]
    assert steps == pytest.approx([0.0, 0.02, 0.0, 0.1])
    jog.rest()
    assert jog.step(JointReading(ns(6.0), STILL, STILL, STILL)) == 0.0
    np.testing.assert_array_equal(jog.setpoint, STILL)


def test_a_restart_stops_the_tool(tmp_path):
    jog, at = VelocityJog(arm_of(tmp_path), 0.1), np.array([BENT[name] for name in FIVE])
    for _ in range(20):
        at = jog.move(at, JogMotion(STILL, np.array([0.1, 0.0, 0.0])), DT)
    jog.restart(at)
    np.testing.assert_array_equal(jog.move(at, JogMotion(STILL), DT), at)


def test_tool_reverses_at_once_also_after_a_rest(tmp_path):
    jog, at = VelocityJog(arm_of(tmp_path), 0.1), np.array([BENT[name] for name in FIVE])
    forward = JogMotion(STILL, np.array([0.1, 0.0, 0.0]))
    for _ in range(400):
        jog.move(at, forward, DT)
    for _ in range(50):
        jog.move(at, JogMotion(STILL), DT)
    back = jog.move(at, attrs.evolve(forward, linear=-forward.linear), DT)
    assert np.max(np.abs(back - at)) < 0.02
