"""The plugin's hooks: hardware, teleop and sensor `lerobot`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import Check, HardwareDescriptor, OptionFault, SensorDescriptor, TeleopDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_lerobot_devices.options import CameraOptions, CmdVelOptions, RobotOptions, TeleopOptions

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import Context, Hardware, Robot, Sensor, Teleop


def _robot(options: Any, ctx: Context) -> Hardware:
    from ibrobot_lerobot_devices.hardware import LeRobotHardware

    return LeRobotHardware(options, ctx)


def _check_robot(options: RobotOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_lerobot_devices.registry import check_device, check_joints

    yield from check_device("robot", "robot", options.robot, options.config)
    yield from check_joints(options, robot)


def _teleop(options: Any, ctx: Context) -> Teleop:
    from ibrobot_lerobot_devices.teleop import LeRobotTeleop

    return LeRobotTeleop(options, ctx)


def _check_teleop(options: TeleopOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_lerobot_devices.registry import check_device, check_joints

    yield from check_device("teleoperator", "teleop", options.teleop, options.config)
    yield from check_joints(options, robot)


def _cmd_vel(options: Any, ctx: Context) -> Teleop:
    from ibrobot_lerobot_devices.cmd_vel import CmdVelTeleop

    return CmdVelTeleop(options, ctx)


def _camera(options: Any, ctx: Context) -> Sensor:
    from ibrobot_lerobot_devices.camera import LeRobotCamera

    return LeRobotCamera(options, ctx)


def _check_camera(options: CameraOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_lerobot_devices.registry import check_device

    return check_device("camera", "camera", options.camera, options.config)


def _port(options: Any) -> Mapping[str, str]:
    """The serial port of a device, if its config has one."""
    port = options.config.get("port")
    return {"port": os.path.realpath(port)} if isinstance(port, str) else {}


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """Robots."""
    yield HardwareDescriptor(
        type="lerobot", options=RobotOptions, make=_robot, check_options=_check_robot, devices=_port,
        anchored=lambda options: options.anchored, torque_off="ibrobot lerobot torque-off",
        summary="a robot of LeRobot's, in a process of its own",
    )  # fmt: skip


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """Teleoperators with joint positions, and twists for a base."""
    yield TeleopDescriptor(
        type="lerobot", options=TeleopOptions, make=_teleop, check_options=_check_teleop, devices=_port,
        keys=lambda options, robot: {} if options.deadman == "none" else {options.deadman_key: "deadman"},
        needs_terminal=lambda options: options.deadman != "none",
        summary="a teleoperator of LeRobot's with joint positions, e.g. a leader arm", label="follow LeRobot's device",
    )  # fmt: skip

    yield TeleopDescriptor(
        type="cmd_vel", options=CmdVelOptions, make=_cmd_vel, summary="drives a base by a topic of twists",
        label="drive the base by twists on a topic",
    )  # fmt: skip


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """Cameras."""
    yield SensorDescriptor(
        type="lerobot", options=CameraOptions, make=_camera, check_options=_check_camera,
        picture=lambda options: options.picture, summary="a camera of LeRobot's",
    )  # fmt: skip


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check LeRobot, and say what its devices do not report."""
    from ibrobot_lerobot_devices.link import INSTALL, is_installed

    if not is_installed():
        yield Check("LeRobot", False, "not installed; devices of type lerobot need it", INSTALL, matters=False)
        return
    lacks = "its robots report no torque, temperature or voltage, so that only positions are checked in a run"
    yield Check("LeRobot", True, f"{version('lerobot')}; {lacks}")


def _commands() -> click.Command:
    from ibrobot_lerobot_devices.commands import lerobot

    return lerobot


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot lerobot …`."""
    yield Command("lerobot", "List LeRobot's robots, teleoperators and cameras.", _commands)
