"""The plugin's hooks: section `description`, which is optional for robots with a URDF or mounted sensors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import SectionDescriptor

if TYPE_CHECKING:
    from ibrobot_core.app import RobotConfig


def _has_frames(config: RobotConfig) -> bool:
    mounted = any(peripheral.transform is not None for peripheral in config.peripherals.values())
    return mounted or config.robot.description.urdf is not None


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The section `description`, the counterpart of robot_state_publisher."""
    yield SectionDescriptor(
        type="description",
        make=lambda options, session: Late("ibrobot_description.component:DescriptionPublisher")(session),
        without_section=_has_frames,
        check_config=Late("ibrobot_description.check:faults"),
        summary="/tf, /tf_static and /robot_description from the URDF and the mounts of sensors; has no keys",
    )
