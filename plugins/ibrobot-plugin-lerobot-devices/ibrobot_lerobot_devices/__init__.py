"""The plugin's hooks: hardware, teleop and sensor `lerobot`."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import version

from ibrobot_core.api import Check, HardwareDescriptor, Late, SensorDescriptor, TeleopDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_lerobot_devices.options import CameraOptions, CmdVelOptions, RobotOptions, TeleopOptions


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """Robots."""
    yield HardwareDescriptor(
        type="lerobot",
        options=RobotOptions,
        make=Late("ibrobot_lerobot_devices.hardware:LeRobotHardware"),
        torque_off="ibrobot lerobot torque-off",
        summary="a robot of LeRobot's, in a process of its own",
    )


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Teleoperators with joint positions, and twists for a base."""
    yield TeleopDescriptor(
        type="lerobot",
        options=TeleopOptions,
        make=Late("ibrobot_lerobot_devices.teleop:LeRobotTeleop"),
        summary="a teleoperator of LeRobot's with joint positions, e.g. a leader arm",
        label="follow LeRobot's device",
    )

    yield TeleopDescriptor(
        type="cmd_vel",
        options=CmdVelOptions,
        make=Late("ibrobot_lerobot_devices.cmd_vel:CmdVelTeleop"),
        summary="drives a base by a topic of twists",
        label="drive the base by twists on a topic",
    )


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """Cameras."""
    yield SensorDescriptor(
        type="lerobot",
        options=CameraOptions,
        make=Late("ibrobot_lerobot_devices.camera:LeRobotCamera"),
        summary="a camera of LeRobot's",
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check LeRobot, and say what its devices do not report."""
    from ibrobot_lerobot_devices.link import INSTALL, is_installed

    if not is_installed():
        yield Check("LeRobot", False, "not installed; devices of type lerobot need it", INSTALL, matters=False)
        return
    lacks = "its robots report no torque, temperature or voltage, so that only positions are checked in a run"
    yield Check("LeRobot", True, f"{version('lerobot')}; {lacks}")


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot lerobot …`."""
    yield Command("lerobot", summary="List LeRobot's robots, teleoperators and cameras.")
    yield Command("lerobot list", Late("ibrobot_lerobot_devices.commands:ListDevices"))
    yield Command("lerobot new", Late("ibrobot_lerobot_devices.commands:NewRobot"))
    yield Command("lerobot torque-off", Late("ibrobot_lerobot_devices.commands:TorqueOff"))
