"""The plugin's hooks: hardware, teleop and sensor `lerobot`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import HardwareDescriptor, OptionFault, hookimpl
from ibrobot_core.app import Command
from ibrobot_lerobot_devices.options import RobotOptions

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import Context, Hardware, Robot


def _robot(options: Any, ctx: Context) -> Hardware:
    from ibrobot_lerobot_devices.hardware import LeRobotHardware

    return LeRobotHardware(options, ctx)


def _check_robot(options: RobotOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_lerobot_devices.registry import check_device, check_joints

    yield from check_device("robot", "robot", options.robot, options.config)
    yield from check_joints(options, robot)


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


def _commands() -> click.Command:
    from ibrobot_lerobot_devices.commands import lerobot

    return lerobot


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot lerobot …`."""
    yield Command("lerobot", "List LeRobot's robots, teleoperators and cameras.", _commands)
