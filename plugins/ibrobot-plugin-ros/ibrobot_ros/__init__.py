"""The plugin's hooks: section `ros`, hardware `ros2_control`, and checks of `ibrobot doctor` for the ROS found here."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Check, HardwareDescriptor, hookimpl
from ibrobot_core.app import SectionDescriptor
from ibrobot_ros.options import Ros2ControlOptions, RosOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Context, Hardware
    from ibrobot_core.app import Component, RunAccess


def _node(options: RosOptions, session: RunAccess) -> Component:
    from ibrobot_ros.section import RosNode

    return RosNode(options, session)


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The node beside a run."""
    yield SectionDescriptor(
        type="ros", options=RosOptions, make=_node, offers=RosOptions.offers,
        summary="a ROS 2 node beside the run: topics, services and actions",
    )  # fmt: skip


def _ros2_control(options: Ros2ControlOptions, ctx: Context) -> Hardware:
    from ibrobot_ros.hardware import Ros2Control

    return Ros2Control(options, ctx)


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """Robots whose controllers run in ROS."""
    yield HardwareDescriptor(
        type="ros2_control", options=Ros2ControlOptions, make=_ros2_control,
        summary="joints that controllers in ROS 2 drive",
    )  # fmt: skip


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """The ROS of this machine."""
    from ibrobot_ros.doctor import checks

    yield from checks()
