"""Links of an MJCF under the names of a URDF, and an SRDF of an arm."""

from __future__ import annotations

from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

from ibrobot_kinematics.urdf import Urdf

from ibrobot_core.api import Robot
from ibrobot_planning.world.arm import Arm, Pair, sorted_pair


def urdf_names(arm: Arm, urdf: Urdf) -> dict[str, str]:
    """Link of the MJCF -> link of the URDF, of the links that the same joints carry, and of the base."""
    children = {joint.name: joint.child for joint in urdf.joints}
    numbers = {int(number): name for number, name in zip(arm.numbers, arm.joint_names, strict=True)}
    names: dict[str, str] = {}
    named: set[int] = set()
    for link, (joint, _) in arm.frames.items():
        # The first link of a joint, from the base outwards, is the one that it carries; others are fixed to it.
        if link == "world" or joint in named:
            continue
        named.add(joint)
        if joint == 0:
            names[link] = urdf.root
        elif numbers[joint] in children:
            names[link] = children[numbers[joint]]
    return names


def srdf(robot: Robot, pairs: Mapping[Pair, str], names: Mapping[str, str]) -> str:
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
    found = {sorted_pair(names[a], names[b]): reason for (a, b), reason in pairs.items() if a in names and b in names}
    lines += [
        f"  <disable_collisions link1={quoteattr(a)} link2={quoteattr(b)} reason={quoteattr(reason)}/>"
        for (a, b), reason in sorted(found.items())
    ]
    return "\n".join([*lines, "</robot>", ""])
