"""Frames: poses of the links of a URDF in their parents, and of mounted sensors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import attrs
from ibrobot_kinematics.urdf import MOVING, UrdfJoint

from ibrobot_core.api import Header, Mount, Quaternion, RobotConfig, TransformStamped, Vector3

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
        rotation = from_rpy(*(mount.rpy or (0.0, 0.0, 0.0)))
        if mount.quaternion is not None:
            length = math.hypot(*mount.quaternion)
            rotation = Quaternion(*(each / length for each in mount.quaternion))
        body = TransformStamped(Header(stamp_ns, mount.parent), self.name, Vector3(*mount.xyz), rotation)
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
    translation, rotation = Vector3(*joint.xyz), from_rpy(*joint.rpy)
    x, y, z = joint.axis
    if joint.type == "prismatic":
        moved = _rotate(rotation, (x * position, y * position, z * position))
        translation = Vector3(translation.x + moved[0], translation.y + moved[1], translation.z + moved[2])
    elif joint.type in MOVING:
        half = math.sin(position / 2)
        rotation = _product(rotation, Quaternion(x * half, y * half, z * half, math.cos(position / 2)))
    return TransformStamped(Header(stamp_ns, joint.parent), joint.child, translation, rotation)


def from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Quaternion of fixed-axis roll, pitch, yaw [rad], as in URDF."""
    result = Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    result = _product(result, Quaternion(0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2)))
    return _product(result, Quaternion(math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)))


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    return Quaternion(
        a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
        a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
    )


def _rotate(q: Quaternion, vector: tuple[float, float, float]) -> tuple[float, float, float]:
    turned = _product(_product(q, Quaternion(*vector, 0.0)), Quaternion(-q.x, -q.y, -q.z, q.w))
    return turned.x, turned.y, turned.z
