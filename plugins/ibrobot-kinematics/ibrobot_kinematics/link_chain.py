"""The pose of one link of a URDF in another, for positions of the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ibrobot_core.api import Vector, did_you_mean
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import exp, from_rpy
from ibrobot_kinematics.urdf import MOVING, Urdf, UrdfJoint


class Chain:
    """The joints between two links.

    Args:
        urdf: the robot.
        joints: names of the robot's joints, in the order of their positions.
        base: the link in which poses are given.
        tip: the link whose poses they are.

    Raises:
        KinematicsError: if the URDF lacks a link, or a joint between them moves that the robot YAML lacks.
    """

    def __init__(self, urdf: Urdf, joints: Sequence[str], base: str, tip: str) -> None:
        for link in (base, tip):
            if link not in urdf.links:
                hint = did_you_mean(link, urdf.links, "its links")
                raise KinematicsError(f"{urdf.path} has no link {link!r}{hint}")
        ways = [urdf.chain(urdf.root, link) or () for link in (base, tip)]
        shared = 0
        while shared < min(map(len, ways)) and ways[0][shared] is ways[1][shared]:
            shared += 1
        self._ways = tuple(way[shared:] for way in ways)
        moving = [joint for way in self._ways for joint in way if joint.type in MOVING]
        if unknown := [joint.name for joint in moving if joint.name not in joints]:
            raise KinematicsError(
                f"{urdf.path}: {unknown[0]} moves between {base} and {tip}, but is not in robot.joints"
            )
        self.names = tuple(joint.name for joint in moving)
        """The joints that move one against the other."""
        self.columns = tuple(joints.index(name) for name in self.names)
        """Their places in a vector of all positions."""
        self._index = {name: joints.index(name) for name in self.names}

    def pose(self, positions: Vector) -> Vector:
        """The tip in the base, shape (4, 4), for positions of all joints [rad or m], shape (J,)."""
        base, tip = (self._placed(way, positions) for way in self._ways)
        return np.asarray(np.linalg.inv(base) @ tip)

    def _placed(self, way: Sequence[UrdfJoint], positions: Vector) -> Vector:
        placed = np.eye(4)
        for joint in way:
            rotation, place = from_rpy(*joint.rpy), np.array(joint.xyz)
            if joint.type in MOVING:
                moved = float(positions[self._index[joint.name]]) * np.array(joint.axis)
                if joint.type == "prismatic":
                    place = place + rotation @ moved
                else:
                    rotation = rotation @ exp(moved)
            placed = placed @ homogeneous(rotation, place)
        return placed
