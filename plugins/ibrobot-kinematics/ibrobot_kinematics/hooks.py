"""The hooks: features, teleop `twist`, sections `tool_pose` and `description`. Importing it imports no NumPy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Late, TeleopDescriptor, hookimpl
from ibrobot_core.app import FeatureDescriptor, SectionDescriptor
from ibrobot_kinematics.options import ToolPoseOptions, TwistOptions

if TYPE_CHECKING:
    from ibrobot_core.app import RobotConfig

_OF_TOOLS = "ibrobot_kinematics.tool_features"
_OF_DELTAS = "ibrobot_kinematics.delta_features"
_VECTORS = Late("ibrobot_kinematics.feature_vectors:FeatureVectors")


@hookimpl
def ibrobot_features() -> Iterable[FeatureDescriptor]:
    """Poses of the tool, and positions of joints relative to the measured ones."""
    yield FeatureDescriptor(
        name="tool",
        model=Late(f"{_OF_TOOLS}:tool_model"),
        make=Late(f"{_OF_TOOLS}:tool_feature"),
        vectors=_VECTORS,
        check_config=Late("ibrobot_kinematics.check_features:faults"),
    )
    yield FeatureDescriptor(
        name="delta",
        model=lambda robot, paths: {},
        make=Late(f"{_OF_DELTAS}:delta_feature"),
        vectors=_VECTORS,
    )


def _has_model(config: RobotConfig) -> bool:
    return config.robot.description.mjcf is not None and not config.robot.description.arms


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """The teleop `twist`, the counterpart of MoveIt Servo."""
    yield TeleopDescriptor(
        type="twist",
        options=TwistOptions,
        make=Late("ibrobot_kinematics.twist:TwistTeleop"),
        label="follow twists on a topic",
        summary="moves the tool along a topic of twists, as MoveIt Servo does",
    )


def _has_frames(config: RobotConfig) -> bool:
    mounted = any(peripheral.transform is not None for peripheral in config.peripherals.values())
    return mounted or config.robot.description.urdf is not None


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The sections `tool_pose` and `description`, the counterpart of robot_state_publisher."""
    yield SectionDescriptor(
        type="tool_pose",
        options=ToolPoseOptions,
        make=lambda options, session: Late("ibrobot_kinematics.tool_pose:ToolPose")(
            options or ToolPoseOptions(), session
        ),
        without_section=_has_model,
        summary="the tool's pose in the base frame, on /robot_status/ee_pose",
    )
    yield SectionDescriptor(
        type="description",
        make=lambda options, session: Late("ibrobot_kinematics.description:DescriptionPublisher")(session),
        without_section=_has_frames,
        check_config=Late("ibrobot_kinematics.check_description:faults"),
        summary="/tf, /tf_static and /robot_description from the URDF and the mounts of sensors; has no keys",
    )
