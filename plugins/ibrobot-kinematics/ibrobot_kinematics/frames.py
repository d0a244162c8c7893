"""Frames: poses of the links of a URDF in their parents, and of mounted sensors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import Header, Quaternion, TransformStamped, Vector3
from ibrobot_core.app import Mount, RobotConfig
from ibrobot_kinematics.poses import orientation
from ibrobot_kinematics.rotations import exp, from_quaternion, from_rpy
from ibrobot_kinematics.urdf import MOVING, UrdfJoint

OPTICAL = Quaternion(-0.5, 0.5, -0.5, 0.5)
"""A camera's optical frame (z ahead, x right, y down) in its body's (x ahead, y left, z up). Source: ROS REP 103."""


@attrs.frozen
class MountedFrame:
    """A frame that a peripheral's `transform` defines."""

    index: int
    """Index of the peripheral in the file."""
    peripheral: str
    name: str
    mount: Mount
    optical: str
    """The frame of a camera's images; empty for other sensors."""

    def transforms(self, stamp_ns: int) -> tuple[TransformStamped, ...]:
        """The frame in its parent, and a camera's optical frame in it."""
        mount = self.mount
        given = mount.quaternion
        rotation = from_quaternion(given) if given is not None else from_rpy(*(mount.rpy or (0.0, 0.0, 0.0)))
        body = TransformStamped(Header(stamp_ns, mount.parent), self.name, Vector3(*mount.xyz), orientation(rotation))
        if not self.optical:
            return (body,)
        return body, TransformStamped(Header(stamp_ns, self.name), self.optical, Vector3(0.0, 0.0, 0.0), OPTICAL)


def mounted(config: RobotConfig) -> Iterator[MountedFrame]:
    """The frames of all peripherals with a `transform`, in file order."""
    items: list[dict[str, Any]] = config.document.get("peripherals") or []
    indices = {item["name"]: i for i, item in enumerate(items)}
    for name, peripheral in config.peripherals.items():
        if (mount := peripheral.transform) is not None:
            optical = f"{name}_optical_frame" if peripheral.kind == "camera" else ""
            yield MountedFrame(indices.get(name, 0), name, mount.frame or f"{name}_frame", mount, optical)


def transform(joint: UrdfJoint, position: float, stamp_ns: int) -> TransformStamped:
    """Pose of a joint's child in its parent, at a position [rad or m] if the joint moves."""
    place, rotation = np.array(joint.xyz), from_rpy(*joint.rpy)
    way = position * np.array(joint.axis)
    if joint.type == "prismatic":
        place = place + rotation @ way
    elif joint.type in MOVING:
        rotation = rotation @ exp(way)
    header, translation = Header(stamp_ns, joint.parent), Vector3(*place.tolist())
    return TransformStamped(header, joint.child, translation, orientation(rotation))
