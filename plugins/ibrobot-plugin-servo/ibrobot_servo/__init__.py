"""The plugin's hooks: teleop `twist`, and section `tool_pose`, which is optional for robots with a model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Late, OptionFault, TeleopDescriptor, hookimpl
from ibrobot_core.app import SectionDescriptor
from ibrobot_servo.options import ToolPoseOptions, TwistOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Robot
    from ibrobot_core.app import RobotConfig


def _check_twist(options: TwistOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    if robot.description.mjcf is None:
        yield OptionFault(("topic",), "twists move a tool, which needs robot.description.mjcf: set it", "mjcf")
    if len({robot.description.arm_of(name) for name in robot.joint_names}) > 1:
        message = "the robot has several arms: give the device one in the mode, e.g. teleop: {left: DEVICE}"
        yield OptionFault((), message)
    if options.frame == robot.description.tip:
        yield OptionFault(("frame",), f"{options.frame!r} is robot.description.tip; give the name of the base frame")


def _check_pose(options: ToolPoseOptions, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    if robot.description.mjcf is None:
        yield OptionFault((), "the pose of the tool needs robot.description.mjcf: set it", "mjcf")
    if robot.description.arms:
        yield OptionFault((), "publishes the pose of one tool, but the robot has several arms: leave the section out")


def _has_model(config: RobotConfig) -> bool:
    return config.robot.description.mjcf is not None and not config.robot.description.arms


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """The teleop `twist`, the counterpart of MoveIt Servo."""
    yield TeleopDescriptor(
        type="twist",
        options=TwistOptions,
        make=Late("ibrobot_servo.teleop:TwistTeleop"),
        check_options=_check_twist,
        label="follow twists on a topic",
        summary="moves the tool along a topic of twists, as MoveIt Servo does",
    )


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The section `tool_pose`."""
    yield SectionDescriptor(
        type="tool_pose",
        options=ToolPoseOptions,
        make=lambda options, session: Late("ibrobot_servo.tool_pose:ToolPose")(options or ToolPoseOptions(), session),
        check_options=_check_pose,
        without_section=_has_model,
        publishes=lambda options: [(("topic",), options.topic)],
        summary="the tool's pose in the base frame, on /robot_status/ee_pose",
    )
