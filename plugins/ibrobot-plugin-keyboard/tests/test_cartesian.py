"""Cartesian jog by keys on arms of five and six joints; the jog itself is tested with ibrobot-kinematics."""

from __future__ import annotations

import queue
from pathlib import Path

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_keyboard.options import KeyboardOptions
from ibrobot_keyboard.teleop import KeyboardTeleop
from ibrobot_testing import host_context

from ibrobot_core.api import Description, Joint, JointReading, Robot, TeleopError, Vector, ns

LINKS = {
    "pan": ("0 0 1", "0 0 0.05"),
    "lift": ("0 1 0", "0 0 0.05"),
    "elbow": ("0 1 0", "0.15 0 0"),
    "flex": ("0 1 0", "0.15 0 0"),
    "heading": ("0 0 1", "0.01 0 0"),
    "roll": ("1 0 0", "0.05 0 0"),
    "gripper": ("0 0 1", "0.03 0.01 0"),
}
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


def test_the_toggle_key_changes_between_joints_and_tool(robot):
    typed: queue.SimpleQueue[str] = queue.SimpleQueue()
    teleop = KeyboardTeleop(KeyboardOptions(), host_context(robot=robot, keys=lambda: typed))
    teleop.connect()
    typed.put("release:z")  # the terminal reports releases
    position = bent(robot)

    time_s = 0.0

    rest = seen = position

    def hold(*keys: str) -> Vector:
        """Press keys, and look 0.1 s later; `rest` is where the arm stood before."""
        nonlocal time_s, rest, seen
        for time in np.arange(time_s, time_s + 1, DT):
            command = teleop.read(JointReading(ns(time), position, position, position))
            if command.positions is not None:
                seen = np.array([command.positions[joint] for joint in robot.joint_names])
        time_s += 1
        rest = seen
        for key in keys:
            typed.put(key)
        for time in np.arange(time_s, time_s + 0.105, DT):
            command = teleop.read(JointReading(ns(time), position, position, position))
        time_s += 0.11
        for key in keys:
            typed.put(f"release:{key}")
        assert command.positions is not None
        seen = np.array([command.positions[joint] for joint in robot.joint_names])
        return seen

    joint = hold("w")
    assert np.count_nonzero(joint - rest) == 1
    assert [line.endswith("  (after m)") for line in teleop.help().splitlines()] == [False, True, False]
    jogged_tool = hold("m", "w", "o")
    assert [line.endswith("  (after m)") for line in teleop.help().splitlines()] == [True, False, False]
    way = tool(robot, jogged_tool)[0] - tool(robot, rest)[0]
    np.testing.assert_allclose(way, [0.008, 0, 0], atol=1.5e-3)  # it speeds up first
    assert jogged_tool[-1] - rest[-1] == pytest.approx(0.1)
    rolled = hold("y")
    (p0, r0), (p1, r1) = tool(robot, rest), tool(robot, rolled)
    np.testing.assert_allclose(p1, p0, atol=2e-3)
    np.testing.assert_allclose(r1[:, 2], r0[:, 2], atol=2e-3)
    assert r0[:, 0] @ r1[:, 1] == pytest.approx(-np.sin(0.04), abs=0.01), "roll turns about the tool's own z axis"
    again = hold("m", "w")
    assert np.count_nonzero(again - rest) == 1
    assert "w/s x  a/d y  r/f z  g/t pitch  y/h roll" in teleop.help()
    teleop.disconnect()


def test_the_tool_speeds_up_and_slows_down_within_the_limits(robot):
    typed: queue.SimpleQueue[str] = queue.SimpleQueue()
    teleop = KeyboardTeleop(KeyboardOptions(cartesian_speed=0.3), host_context(robot=robot, keys=lambda: typed))
    teleop.connect()
    position, positions = bent(robot), []
    for key in ("release:z", "m"):
        typed.put(key)
    for tick in range(100):
        if tick in range(10, 30):
            key = "s" if tick < 20 else "r"
            typed.put(key if tick in (10, 20) else f"repeat:{key}")
        reading = JointReading(ns(1 + tick * DT), position, position, position)
        command = teleop.read(reading)
        if command.positions is not None:
            position = np.array([command.positions[joint] for joint in robot.joint_names])
        positions.append(position)
    velocities = np.diff(positions, axis=0) / DT
    assert np.abs(velocities).max() > 0.5
    assert np.abs(np.diff(velocities, axis=0)).max() <= 20.0 * DT + 1e-6
    assert command.positions is None
    assert not velocities[-20:].any()
    teleop.disconnect()


def connect(robot: Robot) -> None:
    KeyboardTeleop(KeyboardOptions(), host_context(robot=robot, keys=queue.SimpleQueue)).connect()


def test_robot_without_a_model_gets_an_error_that_says_what_to_do(robot):
    robot = attrs.evolve(robot, description=Description())
    with pytest.raises(TeleopError, match=r"needs robot\.description\.mjcf: set it, or cartesian: false"):
        connect(robot)


def test_a_model_without_the_tip_or_a_joint_is_refused(robot):
    described = attrs.evolve(robot, description=attrs.evolve(robot.description, tip="nose"))
    message = r"robot\.description: .*has no site 'nose'; it has: tool; set cartesian: false"
    with pytest.raises(TeleopError, match=message):
        connect(described)
    robot.description.mjcf.write_text(robot.description.mjcf.read_text().replace('"lift"', '"lifted"'))
    with pytest.raises(TeleopError, match="has no joint 'lift'; it has: pan, lifted"):
        connect(robot)


def test_a_model_that_cannot_be_read_is_named(robot):
    robot.description.mjcf.write_text("<mujoco")
    with pytest.raises(TeleopError, match=r"robot\.description: .*arm\.xml:1: "):
        connect(robot)
