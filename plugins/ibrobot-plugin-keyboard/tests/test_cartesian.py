"""Cartesian jog on arms of five and six joints."""

from __future__ import annotations

import queue
from pathlib import Path

import attrs
import numpy as np
import pytest
from ibrobot_keyboard.cartesian import CartesianJog
from ibrobot_keyboard.options import KeyboardOptions
from ibrobot_keyboard.teleop import KeyboardTeleop
from ibrobot_testing import host_context

from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import JointReading
from ibrobot_core.robot import Description, Joint, Robot, Vector
from ibrobot_core.units import ns

mujoco = pytest.importorskip("mujoco")

LINKS = {
    "pan": ("0 0 1", "0 0 0.05"), "lift": ("0 1 0", "0 0 0.05"), "elbow": ("0 1 0", "0.15 0 0"),
    "flex": ("0 1 0", "0.15 0 0"), "heading": ("0 0 1", "0.01 0 0"), "roll": ("1 0 0", "0.05 0 0"),
    "gripper": ("0 0 1", "0.03 0.01 0"),
}  # fmt: skip
"""Joint -> axis, and where its body is; with `heading` the arm has six."""
BENT = {"pan": 0.3, "lift": -0.6, "elbow": 1.1, "flex": 0.2, "heading": 0.1, "roll": 0.2, "gripper": 0.4}
DT = 0.01


def make_robot(directory: Path, *joints: str) -> Robot:
    """A robot of these joints, its model on disk; bodies weigh what their shapes say, and a cube lies beside it."""
    model = directory / "arm.xml"
    bodies = ""
    for name in joints:
        axis, position = LINKS[name]
        bodies += f'<body pos="{position}"><joint name="{name}" axis="{axis}" range="-3 3" limited="true"/>'
        bodies += '<geom size="0.01"/>'
        if name == joints[-2]:
            # The tool points along the arm: its z axis is the arm's x.
            bodies += '<site name="tool" pos="0.08 0 0" xyaxes="0 0 -1 0 1 0"/>'
    cube = '<body pos="1 0 0"><freejoint/><geom size="0.01"/></body>'
    model.write_text(f"<mujoco><worldbody>{bodies}{'</body>' * len(joints)}{cube}</worldbody></mujoco>")
    return Robot(
        "arm",
        tuple(Joint(name, -1.6, 1.6, max_velocity=3.0, max_acceleration=20.0) for name in joints),
        groups={"gripper": joints[-1:]},
        description=Description(mjcf=model, tip="tool"),
    )


@pytest.fixture(params=[False, True], ids=["five joints", "six joints"])
def robot(request, tmp_path) -> Robot:
    return make_robot(tmp_path, *(name for name in LINKS if request.param or name != "heading"))


def bent(robot: Robot) -> Vector:
    return np.array([BENT[name] for name in robot.joint_names])


def tool(robot: Robot, positions: Vector) -> tuple[Vector, Vector]:
    """Where the tool is [m], shape (3,), and its axes as columns, shape (3, 3), by MuJoCo alone."""
    model = mujoco.MjModel.from_xml_path(str(robot.description.mjcf))
    state = mujoco.MjData(model)
    for name, position in zip(robot.joint_names, positions, strict=True):
        state.joint(name).qpos[0] = position
    mujoco.mj_kinematics(model, state)
    return state.site("tool").xpos.copy(), state.site("tool").xmat.reshape(3, 3).copy()


def turned(before: Vector, after: Vector) -> Vector:
    """The turn between two orientations about the tool's axes [rad], shape (3,), good for small ones."""
    turn = before.T @ after
    return np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2


def jogged(robot: Robot, start: Vector, move: Vector, turn: Vector, ticks: int) -> Vector:
    jog = CartesianJog(robot, robot.joint_names[:-1])
    positions = start
    for _ in range(ticks):
        positions = jog.step(positions, move, turn, DT)
    return positions


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_tool_moves_along_the_axis_and_keeps_pitch_and_roll(robot, axis, sign):
    move = np.zeros(3)
    move[axis] = sign * 0.1
    start = bent(robot)
    (p0, r0), (p1, r1) = (tool(robot, q) for q in (start, jogged(robot, start, move, np.zeros(2), 30)))
    np.testing.assert_allclose(p1 - p0, move * 0.3, atol=1e-3)
    np.testing.assert_allclose(turned(r0, r1)[1:], 0, atol=0.02)


def test_six_joints_hold_the_heading_too(tmp_path):
    robot = make_robot(tmp_path, *LINKS)
    start = bent(robot)
    after = jogged(robot, start, np.array([0, 0.1, 0]), np.zeros(2), 30)
    np.testing.assert_allclose(turned(tool(robot, start)[1], tool(robot, after)[1]), 0, atol=0.01)


@pytest.mark.parametrize("axis", [0, 1], ids=["pitch", "roll"])
def test_the_tool_turns_on_the_spot(robot, axis):
    turn = np.zeros(2)
    turn[axis] = 0.5
    start = bent(robot)
    (p0, r0), (p1, r1) = (tool(robot, q) for q in (start, jogged(robot, start, np.zeros(3), turn, 40)))
    np.testing.assert_allclose(p1, p0, atol=2e-3)
    wanted = np.zeros(2)
    wanted[axis] = np.sin(0.2)
    np.testing.assert_allclose(turned(r0, r1)[1:], wanted, atol=0.01)


def test_nothing_but_the_arm_moves(robot):
    start = bent(robot)
    after = jogged(robot, start, np.array([0.1, 0, 0]), np.zeros(2), 30)
    assert after[-1] == start[-1]


@pytest.mark.parametrize("move", [(0.1, 0, 0), (-0.1, 0, 0), (0, 0, -0.1), (0, 0.1, 0.1)])
def test_at_the_edge_of_its_reach_the_tool_stops_and_comes_back(robot, move):
    away = jogged(robot, bent(robot), np.array(move), np.zeros(2), 600)
    assert np.all(np.abs(away) <= 1.6 + 1e-9)
    np.testing.assert_array_equal(jogged(robot, away, np.array(move), np.zeros(2), 5), away)
    back = jogged(robot, away, -np.array(move), np.zeros(2), 30)
    way = tool(robot, back)[0] - tool(robot, away)[0]
    np.testing.assert_allclose(way, -0.3 * np.array(move), atol=0.01)


def test_no_joint_goes_faster_than_it_may(robot):
    jog = CartesianJog(robot, robot.joint_names[:-1])
    positions = bent(robot)
    for _ in range(100):
        moved = jog.step(positions, np.array([0, 0, 2.0]), np.zeros(2), DT)
        assert np.abs(moved - positions).max() <= 3.0 * DT + 1e-9
        positions = moved


def test_an_arm_outside_its_limits_moves_without_a_jump(robot):
    start = bent(robot)
    start[0] = 1.8
    moved = CartesianJog(robot, robot.joint_names[:-1]).step(start, np.array([0, 0, 0.1]), np.zeros(2), DT)
    assert 0 < np.abs(moved - start).max() <= 3.0 * DT
    assert tool(robot, moved)[0][2] - tool(robot, start)[0][2] == pytest.approx(0.1 * DT, rel=0.1)


def test_a_joint_of_the_model_that_is_not_the_robots_is_not_counted_on(tmp_path):
    whole = make_robot(tmp_path, *(name for name in LINKS if name != "heading"))
    robot = attrs.evolve(whole, joints=whole.joints[1:])
    start = np.zeros(5)
    np.testing.assert_array_equal(jogged(robot, start, np.array([0, 0.1, 0]), np.zeros(2), 5), start)


def test_the_toggle_key_changes_between_joints_and_tool(robot):
    typed: queue.SimpleQueue[str] = queue.SimpleQueue()
    teleop = KeyboardTeleop(KeyboardOptions(), host_context(robot=robot, keys=lambda: typed))
    teleop.connect()
    position = bent(robot)

    def hold(*keys: str) -> Vector:
        """Press keys, and look 0.1 s later."""
        hold.time_s += 1
        for key in keys:
            typed.put(key)
        for time in np.arange(hold.time_s, hold.time_s + 0.105, DT):
            command = teleop.read(JointReading(ns(time), position, position, position))
        return np.array([command.positions[joint] for joint in robot.joint_names])

    hold.time_s = 0.0
    joint = hold("w")
    assert np.count_nonzero(joint - position) == 1
    jogged_tool = hold("m", "w", "o")
    way = tool(robot, jogged_tool)[0] - tool(robot, joint)[0]
    np.testing.assert_allclose(way, [0.01, 0, 0], atol=1e-4)
    assert jogged_tool[-1] - joint[-1] == pytest.approx(0.1)
    again = hold("m", "w")
    assert np.count_nonzero(again - jogged_tool) == 1
    assert "w/s x  a/d y  r/f z  g/t pitch  y/h roll" in teleop.help()
    teleop.disconnect()


def connect(robot: Robot) -> None:
    KeyboardTeleop(KeyboardOptions(), host_context(robot=robot, keys=queue.SimpleQueue)).connect()


def test_a_robot_without_a_model_is_told_what_to_do(robot):
    robot = attrs.evolve(robot, description=Description())
    with pytest.raises(TeleopError, match=r"needs robot\.description\.mjcf: set it, or cartesian: false"):
        connect(robot)


def test_a_model_without_the_tip_or_a_joint_is_refused(robot):
    described = attrs.evolve(robot, description=attrs.evolve(robot.description, tip="nose"))
    with pytest.raises(TeleopError, match=r"robot\.description\.tip: .*has no site 'nose'; it has: tool"):
        connect(described)
    robot.description.mjcf.write_text(robot.description.mjcf.read_text().replace('"lift"', '"lifted"'))
    with pytest.raises(TeleopError, match="has no joint 'lift'; it has: pan, lifted"):
        connect(robot)


def test_a_model_that_cannot_be_read_is_named(robot):
    robot.description.mjcf.write_text("<mujoco")
    with pytest.raises(TeleopError, match=r"robot\.description\.mjcf: .*arm\.xml cannot be loaded"):
        connect(robot)
