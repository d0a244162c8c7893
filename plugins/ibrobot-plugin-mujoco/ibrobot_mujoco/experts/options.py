"""Options of the scripted experts; listing plugins does not import MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import OptionFault, Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


_ONE_ARM = OptionFault(("actions",), "the robot has several arms: `tool` is for one arm")


def _gripper_faults(robot: Robot, name: str) -> Iterator[OptionFault]:
    gripper = robot.groups.get(name, ())
    if len(gripper) != 1:
        yield OptionFault((), f"the scripted expert needs one joint in robot.groups.{name}, got {list(gripper)}")


@documented
@attrs.frozen
class ExpertOptions(Options):
    """Options of a scripted expert. The gripper's positions suit the SO-101 and objects of 2 to 3 cm."""

    chunk_size: int = option(50, ge=1, le=1000, help="number of actions in a chunk")
    rate_hz: float = option(30.0, unit="Hz", gt=0, le=1000, help="rate of the actions; must equal the contract's")
    speed: float = option(0.9, gt=0, le=1, help="fraction of the joints' velocity and acceleration limits to use")
    hover_height: float = option(0.07, unit="m", gt=0, le=0.2, help="height above an object before and after grasping")
    release_height: float = option(0.07, unit="m", gt=0, le=0.3, help="height above the bin's centre at the release")
    gripper_open: float = option(0.6, unit="rad", help="position of the open gripper")
    gripper_closed: float = option(-0.1, unit="rad", help="goal of the closing gripper; the object stops it before")
    actions: str = option(
        "joints",
        choices=("joints", "tool"),
        help="joints: their positions; tool: `tool.position` and `tool.rotation_6d`, and the position of the gripper, "
        "for one arm",
    )

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the robot has a gripper with one joint."""
        yield from _gripper_faults(robot, "gripper")
        if self.actions == "tool" and robot.description.arms:
            yield _ONE_ARM


@documented
@attrs.frozen
class SortExpertOptions(ExpertOptions):
    """Options of the expert that sorts cubes, which grasps between other ones."""

    cubes: int = option(3, ge=1, le=4, help="number of cubes in the scene")
    gripper_open: float = option(0.4, unit="rad", help="position of the open gripper")


@documented
@attrs.frozen
class HandoverExpertOptions(ExpertOptions):
    """Options of the expert with two arms."""

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterator[OptionFault]:
        """Check that the robot has two arms, each with a gripper with one joint."""
        for name in ("left", "right"):
            yield from _gripper_faults(robot, f"{name}_gripper")
            if name not in robot.groups:
                yield OptionFault((), f"the scripted expert needs robot.groups.{name}, the joints of that arm")
        if self.actions == "tool":
            yield _ONE_ARM
