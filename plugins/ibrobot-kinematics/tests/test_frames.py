"""Frames of a URDF's joints and of mounted sensors."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from ibrobot_kinematics.frames import MountedFrame, transform
from ibrobot_kinematics.poses import orientation
from ibrobot_kinematics.rotations import from_rpy
from ibrobot_kinematics.urdf import UrdfJoint, read_urdf

from ibrobot_core.api import Vector3
from ibrobot_core.app import Mount

URDF = """<robot name="r">
  <link name="base"/><link name="arm"/><link name="slide"/><link name="tool"/>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="1 0 0" rpy="0 0 1.5707963267948966"/><axis xyz="0 0 2"/>
  </joint>
  <joint name="push" type="prismatic">
    <parent link="arm"/><child link="slide"/><origin rpy="0 0 1.5707963267948966"/><axis xyz="1 0 0"/>
  </joint>
  <joint name="flange" type="fixed"><parent link="slide"/><child link="tool"/></joint>
</robot>"""


@pytest.fixture
def joints(tmp_path: Path) -> tuple[UrdfJoint, ...]:
    path = tmp_path / "robot.urdf"
    path.write_text(URDF)
    return read_urdf(path).joints


def test_revolute_joint_turns_about_its_axis_from_its_origin(joints: tuple[UrdfJoint, ...]) -> None:
    turn = transform(joints[0], math.pi / 2, 7)
    assert (turn.header.stamp_ns, turn.header.frame_id, turn.child_frame_id) == (7, "base", "arm")
    assert turn.translation == Vector3(1.0, 0.0, 0.0)
    assert (turn.rotation.x, turn.rotation.y) == (0.0, 0.0)
    assert turn.rotation.z == pytest.approx(1.0)
    assert turn.rotation.w == pytest.approx(0.0, abs=1e-12)


def test_prismatic_joint_moves_along_its_axis_in_the_parent_frame(joints: tuple[UrdfJoint, ...]) -> None:
    push = transform(joints[1], 0.25, 0)
    assert push.translation.x == pytest.approx(0.0, abs=1e-12)
    assert push.translation.y == pytest.approx(0.25)
    assert push.rotation.z == pytest.approx(math.sqrt(0.5))


def test_fixed_joint_ignores_the_position(joints: tuple[UrdfJoint, ...]) -> None:
    flange = joints[2]
    assert flange.type == "fixed"
    assert transform(flange, 1.0, 0) == transform(flange, 0.0, 0)


def mounted(optical: str = "", **transform: Any) -> MountedFrame:
    return MountedFrame(0, "top", "top_frame", Mount(parent="base", **transform), optical)


def test_mount_is_a_static_transform_from_its_parent() -> None:
    (body,) = mounted(xyz=(0.1, 0.2, 0.3), rpy=(0.0, 0.0, math.pi / 2)).transforms(5)
    assert (body.header.stamp_ns, body.header.frame_id, body.child_frame_id) == (5, "base", "top_frame")
    assert body.translation == Vector3(0.1, 0.2, 0.3)
    assert body.rotation.z == pytest.approx(math.sqrt(0.5))
    assert body.rotation.w == pytest.approx(math.sqrt(0.5))


def test_quaternion_of_a_mount_has_exactly_unit_length() -> None:
    (body,) = mounted(quaternion=(0.0, 0.0, 0.7071, 0.7071)).transforms(0)
    assert math.hypot(body.rotation.x, body.rotation.y, body.rotation.z, body.rotation.w) == pytest.approx(1, abs=1e-15)


def test_optical_frame_of_a_camera_looks_along_its_body() -> None:
    _, optical = mounted("top_optical_frame").transforms(0)
    assert (optical.header.frame_id, optical.child_frame_id) == ("top_frame", "top_optical_frame")
    expected = orientation(from_rpy(-math.pi / 2, 0.0, -math.pi / 2))  # z ahead, x right, y down
    for name in "xyzw":
        assert getattr(optical.rotation, name) == pytest.approx(getattr(expected, name))
