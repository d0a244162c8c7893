"""What only shows between sections: a plugin's options against the robot, and devices opened by two components."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import attrs
import pytest

from ibrobot_core.api import Options
from ibrobot_core.config import RobotConfig
from ibrobot_core.descriptors import TeleopDescriptor
from ibrobot_core.errors import ConfigError
from ibrobot_core.options import OptionFault, did_you_mean, option
from ibrobot_core.plugins import Entry, Registry
from ibrobot_core.robot import Robot

Load = Callable[..., RobotConfig]


@attrs.frozen
class StickOptions(Options):
    port: str = option("", help="serial port")
    inverted: tuple[str, ...] = option((), help="joints that turn the other way")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        for i, name in enumerate(self.inverted):
            if name not in joints:
                yield OptionFault(("inverted", i), f"unknown joint {name!r}{did_you_mean(name, joints, 'known')}")

    def devices(self) -> Mapping[str, str]:
        return {"port": self.port} if self.port else {}


def never_made(options: Any, ctx: Any) -> Any:
    """The `make` of descriptors whose objects no test makes."""


@pytest.fixture(autouse=True)
def checking(registry: Registry) -> None:
    """A made-up device that says what it opens, and checks its options."""
    stick = TeleopDescriptor("stick", never_made, "a stick", StickOptions)
    registry.entries["teleop", "stick"] = Entry("teleop", stick, "fake", "ibrobot-plugin-fake", "1.0")


ABSENT = "package://no_such_robot/arm.xml is in a package that is not installed: pip install no-such-robot"


class WandOptions(Options):
    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        if robot.description.mjcf is None:
            yield OptionFault((), "a wand needs robot.description.mjcf: set it", "mjcf")


@pytest.fixture
def with_absent_model(base: str, registry: Registry) -> str:
    """A robot whose model is in a package that is not installed, with a device in mode `tool` that needs the model."""
    wand = TeleopDescriptor("wand", never_made, "a wand", WandOptions)
    registry.entries["teleop", "wand"] = Entry("teleop", wand, "fake", "ibrobot-plugin-fake", "1.0")
    text = base.replace("    poses:", "    mjcf: package://no_such_robot/arm.xml\n    poses:", 1)
    text = text.replace("teleoperation:", "teleoperation:\n  tool: {type: wand}", 1)
    return text.replace("control_modes:", "control_modes:\n  tool: {executors: [arm_position], teleop: tool}", 1)


def test_model_that_is_not_installed_makes_only_the_modes_that_need_it_unavailable(
    with_absent_model: str, load_text: Load
) -> None:
    config = load_text(with_absent_model)
    reason = f"robot.description.mjcf: {ABSENT}"
    assert {model: str(error) for model, error in config.absent_models.items()} == {"mjcf": reason}
    assert config.unavailable == {"tool": reason}
    assert config.robot.description.mjcf is None
    assert next(str(error) for error in config.missing if error.type == "mjcf") == reason


def test_model_that_the_entered_mode_needs_must_be_installed(with_absent_model: str, load_text: Load) -> None:
    message = faults(load_text, with_absent_model, mode="tool")
    assert message == f"robot.yaml:33: teleoperation.tool: robot.description.mjcf: {ABSENT}"


def faults(load_text: Load, text: str, **options: Any) -> str:
    with pytest.raises(ConfigError) as message:
        load_text(text, **options)
    return str(message.value)


def test_joint_that_an_option_names_must_exist(load_text: Load, base: str) -> None:
    text = base.replace("stick: {type: stick}", "stick: {type: stick, inverted: [pan, litf]}")

    assert faults(load_text, text) == (
        "robot.yaml:31: teleoperation.stick.inverted.1: unknown joint 'litf', did you mean 'lift'?"
    )


def test_camera_used_twice_is_refused(load_text: Load, base: str) -> None:
    text = base.replace("  - {name: chest", "  - {name: side, kind: camera, type: webcam, device: 0}\n  - {name: chest")

    assert faults(load_text, text) == (
        "robot.yaml:16: peripherals.side.device: /dev/video0 is already used by peripherals.top"
    )
    assert load_text(text, sim=True).simulated, "the simulation stands for both cameras"


def test_port_of_hardware_and_leader_must_differ(load_text: Load, base: str) -> None:
    text = base.replace("stick: {type: stick}", "stick: {type: stick, port: /dev/null}")

    assert faults(load_text, text) == ("robot.yaml:31: teleoperation.stick.port: /dev/null is already used by hardware")
    assert load_text(text, sim=True).simulated, "the leader has the port for itself"


def test_port_of_two_arms_must_differ(load_text: Load, base: str) -> None:
    two = textwrap.dedent("""\
        hardware:
          a: {type: bus, port: /dev/null, joints: [pan, lift]}
          b: {type: bus, port: /dev/null, joints: [grip]}""")

    assert faults(load_text, base.replace("hardware: {type: bus, port: /dev/null}", two)) == (
        "robot.yaml:14: hardware.b.port: /dev/null is already used by hardware.a"
    )


def test_devices_of_teleoperation_may_share_a_port(load_text: Load, base: str) -> None:
    """One drives at a time: each belongs to modes of its own."""
    two = "stick: {type: stick, port: /dev/a}\n  mirrored: {type: stick, port: /dev/a, inverted: [pan]}"

    assert load_text(base.replace("stick: {type: stick}", two)).teleoperation.keys() == {"stick", "mirrored"}


def test_transport_that_nothing_uses_is_refused(load_text: Load, base: str, registry: Registry) -> None:
    local = registry.entries["transport", "local"]
    shared = attrs.evolve(local.descriptor, type="shared")
    registry.entries["transport", "shared"] = attrs.evolve(local, descriptor=shared)

    assert faults(load_text, base + "transport: {type: shared}\n") == (
        "robot.yaml:42: transport.type: nothing uses 'shared': no mode has an execution_mode that needs a transport"
    )


MISTAKES = (
    ("{name: pan, lower: -1.0,", "{name: pan, lower: low,"),
    ("poses: {home: [0, 0, 0]}", "poses: {home: [0, 0]}"),
    ("hardware: {type: bus, port: /dev/null}", "hardware: {type: bus, port: /dev/null, baudd: 1}"),
    ("{name: top, kind: camera, type: webcam, fps: 30}", "{name: top, kind: camera, type: webcam, fps: fast}"),
    ("grip_position: {type: position, group: gripper}", "grip_position: {type: position, group: griper}"),
    ("plan: {executors: [arm_trajectory]", "plan: {executors: [arm_trajectry]"),
    ("stick: {type: stick}", "stick: {type: stick, port: /dev/null, inverted: [lyft]}"),
    ("rate_hz: 30", "rate_hz: often"),
    ("control: {rate_hz: 100, stop: hold}", "control: {rate_hz: [100], stop: pose hom}"),
)


def test_independent_mistakes_are_reported_at_once(base: str, load_text: Load) -> None:
    text = base
    for old, new in MISTAKES:
        assert text.count(old) == 1
        text = text.replace(old, new)
    found = faults(load_text, text).splitlines()
    keys = [line.split(": ")[1] for line in found]
    assert keys == [
        "robot.joints.pan.lower",
        "robot.description.poses.home",
        "hardware.baudd",
        "peripherals.top.fps",
        "executors.grip_position.group",
        "control_modes.plan.executors.0",
        "teleoperation.stick.port",
        "teleoperation.stick.inverted.0",
        "contract.rate_hz",
        "control.rate_hz",
        "control.stop",
    ], found
