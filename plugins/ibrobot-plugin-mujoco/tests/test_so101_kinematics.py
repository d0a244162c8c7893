"""Kinematics of the SO-101: solutions are at the target and within the limits; unreachable targets are refused."""

from __future__ import annotations

from typing import Any

import attrs
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicsError, Target, UnreachableError, robot_model, solve
from ibrobot_mujoco.so101 import so101

ROBOT = so101()
ARM = robot_model(ROBOT)
HOME = ROBOT.pose("home")
MODEL = mujoco.MjModel.from_xml_path(str(ROBOT.description.mjcf))
STATE = mujoco.MjData(MODEL)
DOWN = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])

fractions = st.lists(st.floats(0.1, 0.9), min_size=6, max_size=6).map(np.array)


@settings(deadline=None, max_examples=100)
@given(there=fractions, offset=fractions)
def test_finds_the_way_back_to_a_pose_nearby(there: np.ndarray, offset: np.ndarray) -> None:
    there = ROBOT.lower + there * (ROBOT.upper - ROBOT.lower)
    start = there + 0.4 * (offset - 0.5)
    target = ARM.forward(there)
    found = ARM.forward(solution := solve(ARM, Target(target.position, target.rotation), start))
    np.testing.assert_allclose(found.position, target.position, atol=1e-3)
    assert np.trace(found.rotation.T @ target.rotation) >= 1 + 2 * np.cos(0.01)
    assert np.all(solution >= ROBOT.lower)
    assert np.all(solution <= ROBOT.upper)
    assert solution[5] == start[5], "the jaw does not move the tip"


@settings(deadline=None, max_examples=50)
@given(distance=st.floats(0.18, 0.28), bearing=st.floats(-1.2, 1.2), height=st.floats(0.01, 0.1))
def test_reaches_all_over_the_table_from_any_pose(distance: float, bearing: float, height: float) -> None:
    position = np.array([distance * np.cos(bearing), distance * np.sin(bearing), height])
    for pose in ("home", "rest"):
        solution = solve(ARM, Target(position, DOWN), ROBOT.pose(pose), rotation_tolerance=3.2)
        np.testing.assert_allclose(ARM.forward(solution).position, position, atol=1e-3)


@settings(deadline=None)
@given(share=st.lists(st.floats(0, 1), min_size=6, max_size=6).map(np.array))
def test_forward_agrees_with_mujoco(share: np.ndarray) -> None:
    joints = ROBOT.lower + share * (ROBOT.upper - ROBOT.lower)
    for name, position in zip(ROBOT.joint_names, joints, strict=True):
        STATE.joint(name).qpos[0] = position
    mujoco.mj_kinematics(MODEL, STATE)
    tip, site = ARM.forward(joints), STATE.site(ROBOT.description.tip)
    np.testing.assert_allclose(tip.position, site.xpos, atol=1e-9)
    np.testing.assert_allclose(tip.rotation.ravel(), site.xmat, atol=1e-9)


def test_forward_at_home() -> None:
    tip = ARM.forward(HOME)
    np.testing.assert_allclose(tip.position, [0.391, 0.0, 0.246], atol=2e-3)
    np.testing.assert_allclose(tip.rotation[:, 2], [1, 0, 0], atol=1e-3)


def test_equal_searches_give_equal_bits() -> None:
    target = Target(np.array([0.22, 0.05, 0.03]), DOWN)
    first = solve(ARM, target, HOME, rotation_tolerance=1.0)
    solve(ARM, Target(np.array([0.2, -0.1, 0.05]), DOWN), HOME, rotation_tolerance=1.0)
    np.testing.assert_array_equal(solve(ARM, target, HOME, rotation_tolerance=1.0), first)


def test_a_narrower_limit_of_the_robot_holds() -> None:
    free = solve(ARM, Target(np.array([0.15, 0.18, 0.05]), DOWN), HOME, rotation_tolerance=1.0)
    assert free[0] < -0.6
    pan = attrs.evolve(ROBOT.joints[0], lower=-0.5)
    narrow = robot_model(attrs.evolve(ROBOT, joints=(pan, *ROBOT.joints[1:])))
    with pytest.raises(UnreachableError, match=r"cannot reach \(0.150, 0.180, 0.050\) m"):
        solve(narrow, Target(np.array([0.15, 0.18, 0.05]), DOWN), HOME, rotation_tolerance=1.0)


def test_a_wide_tolerance_turns_the_tip_no_further_than_it_must() -> None:
    solution = solve(ARM, Target(np.array([0.2, -0.12, 0.09]), DOWN), ROBOT.pose("rest"), rotation_tolerance=1.2)
    np.testing.assert_allclose(ARM.forward(solution).rotation[:, 2], DOWN[:, 2], atol=0.02)


def test_joints_come_in_the_order_of_the_robot() -> None:
    turned = robot_model(attrs.evolve(ROBOT, joints=ROBOT.joints[::-1]))
    target = Target(np.array([0.22, 0.05, 0.03]), DOWN)
    solution = solve(turned, target, HOME, rotation_tolerance=1.0)
    np.testing.assert_allclose(solution[::-1], solve(ARM, target, HOME, rotation_tolerance=1.0), atol=1e-6)


def test_the_search_begins_again_where_it_was_led_astray() -> None:
    position, astray = np.array([0.150, -0.060, 0.017]), np.array([-0.87, 0.71, 1.50, -1.24, 2.00, -0.06])
    solution = solve(ARM, Target(position, DOWN), astray, rotation_tolerance=0.5)
    np.testing.assert_allclose(ARM.forward(solution).position, position, atol=1e-3)


def test_out_of_reach_says_how_far() -> None:
    with pytest.raises(UnreachableError, match=r"the nearest is .* \d+\.\d mm"):
        solve(ARM, Target(np.array([0.7, 0.0, 0.1]), DOWN), HOME, rotation_tolerance=7.0)
    with pytest.raises(UnreachableError, match=r"cannot reach \(0.700, 0.000, 0.100\) m .* \d+\.\d mm"):
        solve(ARM, Target(np.array([0.7, 0.0, 0.1]), DOWN), HOME)


def test_a_lean_is_refused_unless_tolerated() -> None:
    high = Target(np.array([0.24, 0.0, 0.12]), DOWN)
    with pytest.raises(UnreachableError, match=r"0\.0 mm and \d\d\.\d degrees off"):
        solve(ARM, high, HOME, rotation_tolerance=0.1)
    lean = ARM.forward(solve(ARM, high, HOME, rotation_tolerance=0.8))
    np.testing.assert_allclose(lean.position, high.position, atol=1e-3)
    assert 0 < lean.rotation[0, 2] < 0.8, "it does not lean away from the base"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mjcf": None}, r"robot 'so101' has no robot\.description\.mjcf"),
        ({"tip": "nose"}, r"robot\.description: .*has no site 'nose'; it has: .*gripperframe"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(change: dict[str, Any], message: str) -> None:
    robot = attrs.evolve(ROBOT, description=attrs.evolve(ROBOT.description, **change))
    with pytest.raises(KinematicsError, match=message):
        robot_model(robot)


def test_a_joint_that_the_model_lacks_is_named() -> None:
    robot = attrs.evolve(ROBOT, joints=(*ROBOT.joints, attrs.evolve(ROBOT.joints[0], name="tail")))
    with pytest.raises(KinematicsError, match="has no joint 'tail'; it has: shoulder_pan"):
        robot_model(robot)
