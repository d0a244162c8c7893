"""Options of `type: twist` under `teleoperation`, and of the section `tool_pose`."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_core.api import documented, option
from ibrobot_kinematics.servo_options import ServoOptions


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


@documented
@attrs.frozen
class ToolPoseOptions:
    """Keys of the section `tool_pose`."""

    topic: str = option("/robot_status/ee_pose", validator=_check_topic, help="topic of the tool's pose")
    frame: str = option("base_link", help="name of the base frame, in which the pose is given")
    rate_hz: float = option(20.0, unit="Hz", gt=0, le=1000, help="poses per second, at most one per joint state")
