"""`ibrobot description …`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import attrs

from ibrobot_core.api import Robot, option
from ibrobot_core.app import echo, find_config, installed_plugins, load_config
from ibrobot_planning.world.engines import find_engines

if TYPE_CHECKING:
    from ibrobot_planning.world.arm import Pair


@attrs.frozen(kw_only=True)
class Srdf:
    """Write an SRDF of the robot in CONFIG.

    It has groups, poses, and links whose collisions need no check.

    Two links need no check if one joint connects them, or if they touch in nearly all or in none of the random
    configurations, as in MoveIt's setup assistant. Links have the names of the URDF or, without a URDF, of the MJCF.
    """

    config: str = option(typed="CONFIG", names="robot", help="robot YAML")
    samples: int = option(10_000, ge=1, help="random configurations")
    seed: int = option(0, help="seed of the random configurations")
    output: Path | None = option(None, help="the file; without it, standard output")

    def __call__(self) -> None:
        find_engines()
        from ibrobot_kinematics.urdf import read_urdf

        from ibrobot_planning.world.arm import robot_arm
        from ibrobot_planning.world.checked_arm import urdf_names
        from ibrobot_planning.world.collision import unchecked_pairs

        registry = installed_plugins()
        robot = load_config(find_config(self.config, registry), sim=True, registry=registry).robot
        arm = robot_arm(robot)
        pairs = unchecked_pairs(arm, samples=self.samples, seed=self.seed, never=True)
        urdf = robot.description.urdf
        names = {link: link for link in arm.frames} if urdf is None else urdf_names(arm, read_urdf(urdf))
        text = srdf_of(robot, pairs, names)
        if self.output is None:
            echo(text.removesuffix("\n"))
        else:
            self.output.write_text(text, encoding="utf-8")


def srdf_of(robot: Robot, pairs: Mapping[Pair, str], names: Mapping[str, str]) -> str:
    """An SRDF with the groups and poses of a robot, and the pairs of links that need no check.

    Args:
        robot: the robot.
        pairs: links of the MJCF -> the reason.
        names: what the SRDF calls links of the MJCF; links without a name are left out.
    """
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(robot.name)}>"]
    for group, joints in robot.groups.items():
        lines += [f"  <group name={quoteattr(group)}>"]
        lines += [f"    <joint name={quoteattr(joint)}/>" for joint in joints]
        lines += ["  </group>"]
    for pose in robot.description.poses:
        positions = robot.pose(pose).tolist()
        for group, joints in robot.groups.items():
            lines += [f"  <group_state name={quoteattr(pose)} group={quoteattr(group)}>"]
            lines += [
                f'    <joint name={quoteattr(joint)} value="{positions[robot.joint_names.index(joint)]:g}"/>'
                for joint in joints
            ]
            lines += ["  </group_state>"]
    from ibrobot_planning.world.arm import sorted_pair

    renamed = {sorted_pair(names[a], names[b]): reason for (a, b), reason in pairs.items() if a in names and b in names}
    lines += [
        f"  <disable_collisions link1={quoteattr(a)} link2={quoteattr(b)} reason={quoteattr(reason)}/>"
        for (a, b), reason in sorted(renamed.items())
    ]
    return "\n".join([*lines, "</robot>", ""])
