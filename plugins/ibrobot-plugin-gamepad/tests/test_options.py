"""Mistakes in the section `teleoperation`: each is one error with line, key and what would be right."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import attrs
import pytest
from ibrobot_gamepad.mapping import check_mapping, control_map
from ibrobot_gamepad.options import GamepadOptions, SpaceMouseOptions
from ibrobot_testing import make_robot
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import Description, Joint, Robot, TeleopError
from ibrobot_core.app import ConfigError, load_config

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: lift, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: grip, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan, lift], gripper: [grip]}
  description:
    poses: {home: [0, 0, 0]}
hardware: {type: arm}
executors: {arm: {type: position, group: arm}}
control_modes: {teleop: {executors: [arm], teleop: device}}
default_control_mode: teleop
teleoperation:
  device:
    type: gamepad
    cartesian: false
"""
LINE = ROBOT.count("\n") + 1


@pytest.fixture(autouse=True)
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        yield


def problem(path: Path, text: str) -> str:
    """The one error of a file."""
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    (line,) = str(refused.value).splitlines()
    return line.removeprefix(f"{path}:")


PAD = {
    "joint_sped: 1.0": "joint_sped: unknown key, did you mean 'joint_speed'?",
    "joint_speed: 0": "joint_speed: 0.0 is too small, must be above 0 rad/s",
    "joint_speed: fast": "joint_speed: expected a number, got 'fast'",
    "tool_speed: -0.1": "tool_speed: -0.1 is too small, must be above 0 m/s",
    "turn_speed: .inf": "turn_speed: inf is not a finite number",
    "gripper_speed: .nan": "gripper_speed: nan is too small, must be above 0 rad/s",
    "dead_zone: 0.9": "dead_zone: 0.9 is too large, must be below 0.9",
    "dead_zone: -0.1": "dead_zone: -0.1 is too small, must be at least 0",
    "follow: -1": "follow: -1.0 is too small, must be at least 0 rad",
    "long_press: 9": "long_press: 9.0 is too large, must be at most 5 s",
    "start: joint": "start: 'joint' is not one of: joints, tool",
    "start: tool": "start: the tool cannot be jogged with cartesian: false: must be joints",
    "via: usb": "via: 'usb' is not one of: auto, hid, sdl",
    "gripper: 3": "gripper: expected text, got 3 (quote it: '3')",
    "device: dualsense": "device: 'dualsense' is not VENDOR:PRODUCT or VENDOR:PRODUCT:SERIAL in hexadecimal, e.g. "
    "054c:0ce6; `ibrobot gamepad list` prints them",
    "device: '054c'": "device: '054c' is not VENDOR:PRODUCT",
    "joints: [left_x]": "joints: expected a mapping, got a list",
    "joints: {pan: left_xx}": "joints: pan: unknown axis 'left_xx', did you mean 'left_x'?",
    "joints: {pan: -stick}": "joints: pan: unknown axis '-stick'; the axes are: left_x, left_y, right_x, ",
    "joints: {pan: --left_x}": "joints: pan: unknown axis '--left_x', did you mean 'left_x'?",
    "joints: {pan: 7}": "joints.pan: expected text, got 7 (quote it: '7')",
    "joints: {pam: left_y}": "joints.pam: unknown joint, did you mean 'pan'?",
    "joints: {grip: left_y}": "joints.grip: unknown joint; the arm has: pan, lift",
    "joints: {pan: left_y}": "joints: 'left_y' is both pan and lift: assign it to one of them",
    "joints: {pan: left_trigger}": "joints: 'left_trigger' is both gripper_open and pan: assign it to one of them",
    "tool: {forward: left_y}": "tool: unknown axis of the tool 'forward'; they are: x, y, z, roll, pitch, yaw",
    "tool: {rol: left_y}": "tool: unknown axis of the tool 'rol', did you mean 'roll'?",
    "tool: {x: lefty}": "tool: x: unknown axis 'lefty', did you mean 'left_y'?",
    "buttons: {dead_man: south}": "buttons: unknown function 'dead_man', did you mean 'deadman'?",
    "buttons: {jump: south}": "buttons: unknown function 'jump'; the functions are: deadman, toggle, gripper_open, ",
    "buttons: {estop: soth}": "buttons: estop: unknown button 'soth', did you mean 'south'?",
    "buttons: {estop: A}": "buttons: estop: unknown button 'A'; the buttons are: south, east, west, north, ",
    "buttons: {estop: button}": "buttons: estop: unknown button 'button'",
    "buttons: {deadman: none}": "buttons: deadman: must have a button: the robot moves only while it is held",
    "buttons: {estop: south}": "buttons: 'south' is both estop and success: assign it to one of them",
    "buttons: {estop: left_x}": "buttons: 'left_x' is both estop and pan: assign it to one of them",
    "poses: {hom: west}": "poses.hom: unknown pose, did you mean 'home'?",
    "poses: {rest: north}": "poses.rest: unknown pose; the robot has: home",
    "poses: {home: wst}": "poses: home: unknown button 'wst', did you mean 'west'?",
    "poses: {home: start}": "poses: 'start' is both start and home: assign it to one of them",
}


@pytest.mark.parametrize(("line", "message"), PAD.items(), ids=PAD)
def test_mistakes_are_named_with_line_and_key(tmp_path: Path, line: str, message: str):
    text = ROBOT.replace("    cartesian: false\n", f"    cartesian: false\n    {line}\n")
    error = problem(tmp_path / "mini.yaml", text)
    assert error.startswith(f"{LINE}: teleoperation.device.{message}")


MOUSE = {
    "joints: {pan: left_x}": "joints: pan: unknown axis 'left_x'; the axes are: x, y, z, roll, pitch, yaw",
    "joints: {pan: axis0}": "joints: pan: unknown axis 'axis0'; the axes are: x, y, z, roll, pitch, yaw",
    "buttons: {deadman: south}": "buttons: deadman: unknown button 'south'; the buttons are: left, right, button3, ",
    "buttons: {gripper: left}": "buttons: 'left' is both deadman and gripper: assign it to one of them",
    "via: sdl": "via: unknown key",
}


@pytest.mark.parametrize(("line", "message"), MOUSE.items(), ids=MOUSE)
def test_a_spacemouse_has_controls_of_its_own(tmp_path: Path, line: str, message: str):
    text = ROBOT.replace("gamepad", "spacemouse")
    text = text.replace("    cartesian: false\n", f"    cartesian: false\n    {line}\n    start: joints\n")
    assert problem(tmp_path / "mini.yaml", text).startswith(f"{LINE}: teleoperation.device.{message}")


def test_tool_jog_needs_a_model(tmp_path: Path):
    error = problem(tmp_path / "mini.yaml", ROBOT.replace("cartesian: false", "cartesian: true"))
    expected = "cartesian: tool jog needs robot.description.mjcf: set it, or cartesian: false"
    assert error == f"{LINE - 1}: teleoperation.device.{expected}"


def test_a_robot_without_a_gripper_has_no_gripper_controls():
    robot = attrs.evolve(make_robot(), groups={})
    options = GamepadOptions(cartesian=False)
    assert not {"gripper_open", "gripper_close"} & set(control_map(options, robot).buttons)
    own = attrs.evolve(options, buttons={"estop": "left_trigger"})
    assert control_map(own, robot).buttons["estop"] == "left_trigger", "nothing else has it"
    wrong = attrs.evolve(options, buttons={"gripper": "misc"})
    with pytest.raises(TeleopError, match=r"^buttons\.gripper: the robot has no group 'gripper'$"):
        control_map(wrong, robot)


def test_more_joints_than_axes_need_axes_of_their_own():
    robot = Robot("long", tuple(Joint(f"j{i}", -1, 1, 1, 1) for i in range(7)))
    options = GamepadOptions(cartesian=False)
    with pytest.raises(TeleopError, match=r"^joints: no axis is left for j6: give it one, or `j6: none`$"):
        control_map(options, robot)
    none = control_map(attrs.evolve(options, joints={"j6": "none"}), robot)
    assert "j6" not in none.joints
    own = control_map(attrs.evolve(options, joints={"j6": "-axis7"}), robot)
    assert str(own.joints["j6"]) == "-axis7"


@pytest.mark.parametrize("options", [GamepadOptions(), SpaceMouseOptions()], ids=["gamepad", "spacemouse"])
def test_the_defaults_fit_an_arm_with_a_model(options: GamepadOptions | SpaceMouseOptions):
    poses = make_robot().description.poses
    robot = attrs.evolve(make_robot(), description=Description(mjcf=Path("arm.xml"), poses=poses))
    assert list(check_mapping(options, robot)) == []
    assert list(control_map(options, robot).tool) == ["x", "y", "z", "roll", "pitch", "yaw"]


def test_the_options_have_the_events_with_a_button():
    assert GamepadOptions().events() == ("start", "success", "failure", "discard", "intervention")
    assert GamepadOptions(buttons={"start": "none", "discard": "none"}).events() == (
        "success",
        "failure",
        "intervention",
    )
    assert SpaceMouseOptions().events() == ()
    assert SpaceMouseOptions(buttons={"start": "button3"}).events() == ("start",)
