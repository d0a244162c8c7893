"""Teleoperation devices that move groups of joints, several in one mode: what is accepted, and each mistake."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import attrs
import pytest

from ibrobot_core.api import Options
from ibrobot_core.config import RobotConfig
from ibrobot_core.descriptors import TeleopDescriptor
from ibrobot_core.errors import ConfigError
from ibrobot_core.options import OptionFault, option
from ibrobot_core.plugins import Entry, Registry
from ibrobot_core.robot import Robot

Load = Callable[..., RobotConfig]

TWO = (
    ("teleop: stick}", "teleop: {arm: left, gripper: right}}"),
    ("stick: {type: stick}", "left: {type: wired, port: /dev/a, joint: lift}\n  right: {type: wired, port: /dev/b}"),
)
"""Edits of the base YAML: two devices, one for the arm and one for the gripper, in the mode of line 27."""
MODE, SHIFTED = "robot.yaml:27: control_modes.teleop", "robot.yaml:28: control_modes.teleop"
CASES = {
    "no device": ([("{arm: left, gripper: right}", "{}")], f"{MODE}.teleop: a joint group and its device are missing, "
        "e.g. left: leader_left"),
    "list": ([("{arm: left, gripper: right}", "[left, right]")],
        f"{MODE}.teleop: expected text or a mapping, got a list"),
    "number": ([("gripper: right", "gripper: 3")], f"{MODE}.teleop.gripper: expected text, got 3 (quote it: '3')"),
    "unknown group": ([("gripper: right", "griper: right")],
        f"{MODE}.teleop.griper: unknown group 'griper', did you mean 'gripper'?"),
    "empty group": ([("gripper: right", '"": right')], f"{MODE}.teleop.: unknown group ''; known: arm, gripper"),
    "unknown device": ([("gripper: right", "gripper: rigt")],
        f"{MODE}.teleop.gripper: unknown teleoperation device 'rigt', did you mean 'right'?"),
    "device twice": ([("gripper: right", "gripper: left"), (", joint: lift", "")],
        f"{MODE}.teleop.gripper: device 'left' is given twice"),
    "joint of two groups": (
        [("gripper: right", "hand: right"), ("gripper: [grip]", "gripper: [grip]\n    hand: [lift]")],
        f"{SHIFTED}.executors.0: executor 'arm_position' follows only one device that moves all of its joints: "
        "pan by left, lift by right\n"
        f"{SHIFTED}.teleop.hand: groups 'arm' and 'hand' both have joint 'lift'"),
    "part of an executor": (
        [("{arm: left, gripper: right}", "{hand: left}"), ("gripper: [grip]", "gripper: [grip]\n    hand: [lift]")],
        f"{SHIFTED}.executors.0: executor 'arm_position' follows only one device that moves all of its joints: "
        "pan by none, lift by left"),
    "no executor": ([("[arm_position, grip_position], teleop", "[arm_position], teleop")],
        f"{MODE}.teleop.gripper: no executor of this mode moves grip"),
    "wrong joint": ([("joint: lift", "joint: grip")],
        "robot.yaml:31: teleoperation.left.joint: no joint 'grip', only pan, lift"),
    "same port": ([("/dev/b", "/dev/a")],
        "robot.yaml:32: teleoperation.right.port: /dev/a is already used by teleoperation.left"),
    "key of two meanings": ([("/dev/b", "/dev/b, deadman: z, stop: space")],
        f"{MODE}.teleop.gripper: key 'space' is both emergency stop (right) and deadman (left); give one of them "
        "another key"),
    "key of the run": ([("/dev/b", "/dev/b, deadman: f1, stop: tab")],
        "robot.yaml:32: teleoperation.right.deadman: key 'f1' is both deadman and, in every run, mode switch; choose "
        "another key\n"
        "robot.yaml:32: teleoperation.right.stop: key 'tab' is both emergency stop and, in every run, start and end of "
        "an episode; choose another key"),
    "two sources": ([("gripper: right}}", "gripper: right}, planner: {type: straight}}")],
        f"{MODE}.planner: teleop already drives this mode; make a mode for each"),
    "goals": ([("[arm_position, grip_position], teleop", "[arm_trajectory, grip_position], teleop")],
        f"{MODE}.executors.0: executor 'arm_trajectory' takes goals, but teleop sends setpoints; use one that takes "
        "setpoints"),
    "arm without joints": ([("poses:", "arms: {left_: [0, 0, 0, 0]}\n    poses:")],
        "robot.yaml:11: robot.description.arms.left_: no joint's name begins with 'left_'"),
    "arm without yaw": ([("poses:", "arms: {p: [0, 0, 0]}\n    poses:")],
        "robot.yaml:11: robot.description.arms.p: expected a list of 4 values, got 3"),
}  # fmt: skip


@attrs.frozen
class WiredOptions(Options):
    port: str = option(help="serial port")
    joint: str = option("", help="a joint that it moves")
    deadman: str = option("space", help="key of the deadman")
    stop: str = option("esc", help="key of the emergency stop")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        if self.joint and self.joint not in joints:
            yield OptionFault(("joint",), f"no joint {self.joint!r}, only {', '.join(joints)}")

    def devices(self) -> Mapping[str, str]:
        return {"port": self.port}

    def terminal_keys(self, robot: Robot) -> Mapping[str, str]:
        return {self.deadman: "deadman", self.stop: "emergency stop"}


@pytest.fixture
def registry(registry: Registry) -> Registry:
    wired = TeleopDescriptor(
        "wired",
        lambda options, ctx: pytest.fail("it is only checked"),
        "a device",
        WiredOptions,
    )
    registry.entries["teleop", "wired"] = Entry("teleop", wired, "fake", "ibrobot-plugin-fake", "1.0")
    return registry


@pytest.fixture
def edited(load_text: Load, base: str) -> Load:
    """Load the base YAML with two devices, after further edits."""

    def load(*edits: tuple[str, str], **options: Any) -> RobotConfig:
        text = base
        for old, new in (*TWO, *edits):
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        return load_text(text, **options)

    return load


def test_groups_map_to_their_devices(edited: Load) -> None:
    mode = edited().control_modes["teleop"]
    assert mode.teleop == {"arm": "left", "gripper": "right"} == mode.devices


def test_one_device_may_move_all_joints(load_text: Load, base: str) -> None:
    assert load_text(base).control_modes["teleop"].devices == {"": "stick"}


@pytest.mark.parametrize("case", CASES)
def test_message(case: str, edited: Load) -> None:
    edits, expected = CASES[case]
    with pytest.raises(ConfigError) as told:
        edited(*edits)
    assert str(told.value) == expected


def test_devices_of_different_modes_may_share_a_port(edited: Load) -> None:
    both = "teleop: {executors: [arm_position, grip_position], teleop: {arm: left, gripper: right}}"
    modes = [
        f"{group}: {{executors: [{group}_position], teleop: {{{group}: {name}}}}}"
        for group, name in (("arm", "left"), ("gripper", "right"))
    ]
    modes[1] = modes[1].replace("gripper_position", "grip_position")
    edited((both, "\n  ".join(modes)), ("/dev/b", "/dev/a"), ("mode: teleop", "mode: arm"))


def test_a_device_that_is_not_installed_makes_only_its_modes_unavailable(edited: Load) -> None:
    config = edited(("right: {type: wired", "right: {type: gamepad"), mode="plan")
    assert list(config.unavailable) == ["teleop"]


def test_a_part_of_a_robot_has_its_joints_groups_and_poses() -> None:
    from ibrobot_testing import make_robot

    part = make_robot().part("gripper")
    assert part.joint_names == ("gripper",)
    assert part.groups == {"gripper": ("gripper",)}
    assert part.description.poses == {"home": (0.0,), "rest": (0.0,)}
