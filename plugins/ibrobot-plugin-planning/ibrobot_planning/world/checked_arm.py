"""A robot's arm with the pairs of links that need no check, and what its SRDF adds."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import attrs
from ibrobot_kinematics.srdf import Srdf, read_srdf
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.api import Robot
from ibrobot_planning.world.arm import SRDF, Arm, Pair, robot_arm, sorted_pair
from ibrobot_planning.world.collision import unchecked_pairs
from ibrobot_planning.world.hulls import with_hulls
from ibrobot_planning.world.semantics import urdf_names


@attrs.frozen(eq=False)
class CheckedArm:
    """A collision model of a robot's arm."""

    arm: Arm
    unchecked: Mapping[Pair, str]
    """Pairs of links that need no check, with the reason."""
    names: Mapping[str, str]
    """Link of the URDF -> link of the MJCF; empty without a URDF."""
    srdf: Srdf | None = None


def checked_arm(robot: Robot, log: logging.Logger) -> CheckedArm:
    """The collision model of a robot, from its MJCF, URDF and SRDF.

    Raises:
        PlanningError: as `robot_arm`.
        KinematicsError: for a URDF or SRDF that cannot be read.
    """
    arm = robot_arm(robot)
    unchecked = unchecked_pairs(arm)
    arm = with_hulls(arm, unchecked)
    if robot.description.urdf is None:
        return CheckedArm(arm, unchecked, {})
    urdf = read_urdf(robot.description.urdf)
    links = {name: link for link, name in urdf_names(arm, urdf).items()}
    if robot.description.srdf is None:
        return CheckedArm(arm, unchecked, links)
    srdf = read_srdf(robot.description.srdf, urdf)
    for pair in srdf.may_touch:
        unknown = [name for name in pair if name not in links]
        if unknown:
            message = "%s: %s and %s are checked nevertheless: no joint of the MJCF carries %s"
            log.warning(message, srdf.path, *pair, unknown[0])
        else:
            unchecked[sorted_pair(links[pair[0]], links[pair[1]])] = SRDF
    return CheckedArm(arm, unchecked, links, srdf)
