"""Options of `type: twist` under `teleoperation`, and of the section `tool_pose`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import OptionFault, Options, documented, option
from ibrobot_kinematics.servo_options import ServoOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


def _check_topic(instance: Any, attribute: attrs.Attribute[Any], topic: str) -> None:
    if not topic.startswith("/") or topic.endswith("/") or " " in topic:
        raise ValueError(f"{topic!r} is not a topic: a topic begins with /, e.g. {attribute.default}")


@documented
@attrs.frozen
class TwistOptions(ServoOptions):
    """Options of `type: twist`; the joints' own limits bound every speed."""

    topic: str = option("/servo_node/delta_twist_cmds", validator=_check_topic, help="topic of the twists")
    status_topic: str = option(
        "/servo_node/status", validator=_check_topic, help="topic of the status, with MoveIt Servo's codes"
    )
    frame: str = option("base_link", help="name of the base frame in twists; the tool's is robot.description.tip")
    gripper: str = option("gripper", help="group of joints that do not belong to the arm")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the robot has one tool with a model, and the frame another name than its link."""
        if robot.description.mjcf is None:
            yield OptionFault(("topic",), "twists move a tool, which needs robot.description.mjcf: set it", "mjcf")
        if len({robot.description.arm_of(name) for name in robot.joint_names}) > 1:
            message = "the robot has several arms: give the device one in the mode, e.g. teleop: {left: DEVICE}"
            yield OptionFault((), message)
        if self.frame == robot.description.tip:
            yield OptionFault(("frame",), f"{self.frame!r} is robot.description.tip; give the name of the base frame")


@documented
@attrs.frozen
class ToolPoseOptions(Options):
    """Keys of the section `tool_pose`."""

    topic: str = option("/robot_status/ee_pose", validator=_check_topic, help="topic of the tool's pose")
    frame: str = option("base_link", help="name of the base frame, in which the pose is given")
    rate_hz: float = option(20.0, unit="Hz", gt=0, le=1000, help="poses per second, at most one per joint state")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the robot has one tool with a model."""
        if robot.description.mjcf is None:
            yield OptionFault((), "the pose of the tool needs robot.description.mjcf: set it", "mjcf")
        if robot.description.arms:
            yield OptionFault(
                (), "publishes the pose of one tool, but the robot has several arms: leave the section out"
            )

    def publishes(self) -> Iterable[tuple[tuple[str | int, ...], str]]:
        """Its topic."""
        return [(("topic",), self.topic)]
