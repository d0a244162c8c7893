"""Transforms from a URDF."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ibrobot_core.errors import ConfigError
from ibrobot_core.launch.outputs.transforms import read_urdf
from ibrobot_core.messages import Vector3

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
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "robot.urdf"
    path.write_text(URDF)
    return path


def test_a_revolute_joint_turns_about_its_axis_from_its_origin(urdf: Path) -> None:
    turn = read_urdf(urdf)[0].transform(math.pi / 2, 7)
    assert (turn.header.stamp_ns, turn.header.frame_id, turn.child_frame_id) == (7, "base", "arm")
    assert turn.translation == Vector3(1.0, 0.0, 0.0)
    assert (turn.rotation.x, turn.rotation.y) == (0.0, 0.0)
    assert turn.rotation.z == pytest.approx(1.0)
    assert turn.rotation.w == pytest.approx(0.0, abs=1e-12)


def test_a_prismatic_joint_moves_along_its_axis_in_the_parent_frame(urdf: Path) -> None:
    push = read_urdf(urdf)[1].transform(0.25, 0)
    assert (push.translation.x, push.translation.y) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.25))
    assert push.rotation.z == pytest.approx(math.sqrt(0.5))


def test_a_fixed_joint_ignores_the_position(urdf: Path) -> None:
    flange = read_urdf(urdf)[2]
    assert flange.type == "fixed"
    assert flange.transform(1.0, 0) == flange.transform(0.0, 0)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<robot><joint", "is not a URDF"),
        ('<robot><joint name="j" type="fixed"><child link="a"/></joint></robot>', "joint 'j' has no parent"),
    ],
)
def test_other_files_are_refused_as_urdf(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "broken.urdf"
    path.write_text(text)
    with pytest.raises(ConfigError, match=why) as caught:
        read_urdf(path)
    assert str(path) in str(caught.value)
