"""SRDFs: groups, named poses and pairs that may touch, and what is wrong with those that do not fit the URDF."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicsError
from ibrobot_kinematics.srdf import GroupState, Srdf, read_srdf
from ibrobot_kinematics.urdf import Urdf, read_urdf

LINKS = ("base", "arm", "wrist", "hand", "finger")
KINDS = ("revolute", "prismatic", "fixed", "revolute")
SRDF = textwrap.dedent("""\
    <robot name="mini">
      <group name="arm"><chain base_link="base" tip_link="hand"/></group>
      <group name="hand"><link name="base"/><link name="finger"/><joint name="j2"/></group>
      <group name="all"><group name="hand"/><group name="arm"/></group>
      <group_state name="home" group="arm"><joint name="j0" value="0.5"/><joint name="j1" value="-0.1"/></group_state>
      <group_state name="home" group="hand"><joint name="j3" value="1"/></group_state>
      <group_state name="open" group="hand"><joint name="j3" value="2"/></group_state>
      <disable_collisions link1="wrist" link2="arm" reason="Adjacent"/>
      <end_effector name="e" parent_link="hand" group="hand"/>
      <gripper name="of another program"/>
    </robot>
    """)


@pytest.fixture
def urdf(tmp_path: Path) -> Urdf:
    links = "".join(f'<link name="{link}"/>' for link in LINKS)
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="{child}"/></joint>'
        for i, (kind, (parent, child)) in enumerate(zip(KINDS, pairwise(LINKS), strict=True))
    )
    path = tmp_path / "robot.urdf"
    path.write_text(f"<robot>{links}{joints}</robot>")
    return read_urdf(path)


Read = Callable[[str], Srdf]


@pytest.fixture
def read(urdf: Urdf, tmp_path: Path) -> Read:
    def run(text: str) -> Srdf:
        path = tmp_path / "robot.srdf"
        path.write_text(text, encoding="utf-8")
        return read_srdf(path, urdf)

    return run


@pytest.fixture
def fault(read: Read, tmp_path: Path) -> Callable[[str], str]:
    def run(text: str) -> str:
        with pytest.raises(KinematicsError) as message:
            read(text)
        return str(message.value).replace(f"{tmp_path}/", "")

    return run


def test_groups_have_their_moving_joints(read: Read) -> None:
    assert read(SRDF).groups == {"arm": ("j0", "j1"), "hand": ("j3",), "all": ("j3", "j0", "j1")}


def test_poses_have_a_name_and_a_group(read: Read) -> None:
    states = read(SRDF).states
    assert GroupState("open", "hand", {"j3": 2.0}) in states
    assert GroupState("home", "arm", {"j0": 0.5, "j1": -0.1}) in states


def test_pairs_that_may_touch_have_no_order(read: Read) -> None:
    assert read(SRDF).may_touch == {("arm", "wrist")}


def test_enabled_pairs_count_against_a_default(read: Read) -> None:
    text = (
        '<robot><disable_default_collisions link="base"/><enable_collisions link1="hand" link2="base"/>'
        '<disable_collisions link1="hand" link2="finger"/></robot>'
    )
    assert read(text).may_touch == {("arm", "base"), ("base", "wrist"), ("base", "finger"), ("finger", "hand")}


def test_pose_of_a_mobile_base_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(
        '<robot><link name="map"/><link name="base"/><link name="arm"/>'
        '<joint name="drive" type="planar"><parent link="map"/><child link="base"/></joint>'
        '<joint name="pan" type="revolute"><parent link="base"/><child link="arm"/></joint></robot>'
    )
    (tmp_path / "robot.srdf").write_text(
        '<robot><group name="all"><joint name="drive"/><joint name="pan"/></group><group_state name="home" group="all">'
        '<joint name="drive" value="0 0 0"/><joint name="pan" value="1"/></group_state></robot>'
    )
    srdf = read_srdf(tmp_path / "robot.srdf", read_urdf(tmp_path / "robot.urdf"))
    assert srdf.groups == {"all": ("pan",)}
    assert [state.positions for state in srdf.states] == [{"pan": 1.0}]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</robot>", "", "robot.srdf:12: not valid XML: no element found"),
        ('<group name="arm">', "<group>", "robot.srdf:2: <group> has no name"),
        ('<group name="all">', '<group name="arm">', "robot.srdf:4: a second group named 'arm', first in line 2"),
        ('base_link="base"', 'base_link="bass"', "robot.srdf:2: unknown link 'bass', did you mean 'base'?"),
        ('base_link="base" tip_link="hand"', 'base_link="hand" tip_link="base"',
         "robot.srdf:2: no chain from 'hand' to 'base': it must lead outwards, from the base to the tip"),
        ('<chain base_link', "<chian base_link", "robot.srdf:2: unknown element <chian>, did you mean <chain>?"),
        ('<link name="finger"/>', '<link name="thumb"/>',
         "robot.srdf:3: unknown link 'thumb'; known: base, arm, wrist, hand, finger"),
        ('<joint name="j2"/>', '<joint name="j9"/>', "robot.srdf:3: unknown joint 'j9'; known: j0, j1, j2, j3"),
        ('<group name="hand"/>', '<group name="all"/>', "robot.srdf:4: group 'all' contains itself: all -> all"),
        ('<group name="hand"/>', '<group name="hnd"/>', "robot.srdf:4: unknown group 'hnd', did you mean 'hand'?"),
        ('name="open" group="hand"', 'name="open" group="han"',
         "robot.srdf:7: unknown group 'han', did you mean 'hand'?"),
        ('name="open" group', 'name="home" group',
         "robot.srdf:7: a second pose named 'home' of group 'hand', first in line 6"),
        ('value="0.5"', 'value="half"', "robot.srdf:5: value is 'half', must be 1 finite number"),
        ('value="0.5"', 'value="inf"', "robot.srdf:5: value is 'inf', must be 1 finite number"),
        (' value="0.5"', "", "robot.srdf:5: value is '', must be 1 finite number"),
        ('name="j1" value', 'name="j0" value', "robot.srdf:5: pose 'home' gives joint 'j0' twice"),
        ('name="j1" value', 'name="j3" value',
         "robot.srdf:5: pose 'home': group 'arm' has no joint 'j3'; its joints are: j0, j1"),
        ('<joint name="j3" value="2"/>', "", "robot.srdf:7: pose 'open' gives no joint a position"),
        ("<disable_collisions", "<disable_collision",
         "robot.srdf:8: unknown element <disable_collision>, did you mean <disable_collisions>?"),
        ('link1="wrist"', 'link1="arm"', "robot.srdf:8: link1 and link2 are both 'arm'; name a pair"),
        ('link1="wrist"', 'link="wrist"', "robot.srdf:8: <disable_collisions> has no link1"),
        ('link1="wrist"', 'link1="wirst"', "robot.srdf:8: unknown link 'wirst', did you mean 'wrist'?"),
    ],
)  # fmt: skip
def test_wrong_files_are_named_with_their_line(fault: Callable[[str], str], old: str, new: str, message: str) -> None:
    assert SRDF.count(old) >= 1
    assert fault(SRDF.replace(old, new, 1)) == message


def test_groups_that_contain_one_another_are_refused(fault: Callable[[str], str]) -> None:
    text = '<robot>\n<group name="a"><group name="b"/></group>\n<group name="b"><group name="a"/></group></robot>'
    assert fault(text) == "robot.srdf:3: group 'a' contains itself: a -> b -> a"


@settings(max_examples=200)
@given(st.integers(0, len(SRDF) - 1), st.integers(0, 40), st.text(alphabet='<>/="abcjlinkgroup 01.-', max_size=20))
def test_damaged_file_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, start: int, size: int, text: str
) -> None:
    folder = tmp_path_factory.getbasetemp()
    links = "".join(f'<link name="{link}"/>' for link in LINKS)
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="{child}"/></joint>'
        for i, (parent, child) in enumerate(pairwise(LINKS))
    )
    (folder / "any.urdf").write_text(f"<robot>{links}{joints}</robot>")
    (folder / "any.srdf").write_text(SRDF[:start] + text + SRDF[start + size :])
    urdf = read_urdf(folder / "any.urdf")
    try:
        srdf = read_srdf(folder / "any.srdf", urdf)
    except KinematicsError:
        pass
    else:
        names = {joint.name for joint in urdf.joints}
        assert all(set(joints) <= names for joints in srdf.groups.values())
        assert all(set(state.positions) <= set(srdf.groups[state.group]) for state in srdf.states)
        assert all(first < second and {first, second} <= set(LINKS) for first, second in srdf.may_touch)
