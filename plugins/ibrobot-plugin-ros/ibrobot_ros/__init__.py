"""The plugin's hooks: section `ros`, hardware `ros2_control`, and checks of `ibrobot doctor` for the ROS found here."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Check, HardwareDescriptor, Late, hookimpl
from ibrobot_core.app import SectionDescriptor
from ibrobot_ros.options import Ros2ControlOptions, RosOptions


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The node beside a run."""
    yield SectionDescriptor(
        type="ros",
        options=RosOptions,
        make=Late("ibrobot_ros.section:RosNode"),
        summary="a ROS 2 node beside the run: topics, services and actions",
    )


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """Robots whose controllers run in ROS."""
    yield HardwareDescriptor(
        type="ros2_control",
        options=Ros2ControlOptions,
        make=Late("ibrobot_ros.hardware:Ros2Control"),
        summary="joints that controllers in ROS 2 drive",
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """The ROS of this machine."""
    from ibrobot_ros.doctor import checks

    yield from checks()
