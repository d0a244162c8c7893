"""URDFs: what is read of them, and what is wrong with those that are no tree."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicsError
from ibrobot_kinematics.urdf import Urdf, read_urdf

ARM = textwrap.dedent("""\
    <robot name="mini">
      <link name="tool"/>
      <link name="base"/>
      <link name="arm"/>
      <joint name="pan" type="revolute">
        <origin xyz="0 0 0.1" rpy="0 0 1"/><parent link="base"/><child link="arm"/><axis xyz="0 0 2"/>
      </joint>
      <joint name="flange" type="fixed"><parent link="arm"/><child link="tool"/></joint>
      <transmission name="t"><joint name="pan"/></transmission>
    </robot>
    """)

Read = Callable[[str], Urdf]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def run(text: str) -> Urdf:
        path = tmp_path / "robot.urdf"
        path.write_text(text, encoding="utf-8")
        return read_urdf(path)

    return run


@pytest.fixture
def fault(read: Read, tmp_path: Path) -> Callable[[str], str]:
    def run(text: str) -> str:
        with pytest.raises(KinematicsError) as message:
            read(text)
        return str(message.value).replace(f"{tmp_path}/", "")

    return run


def test_links_and_joints_are_in_file_order(read: Read) -> None:
    urdf = read(ARM)
    assert (urdf.name, urdf.links, urdf.root) == ("mini", ("tool", "base", "arm"), "base")
    pan, flange = urdf.joints
    assert (pan.name, pan.type, pan.parent, pan.child, pan.element.line) == ("pan", "revolute", "base", "arm", 5)
    assert (pan.xyz, pan.rpy, pan.axis) == ((0.0, 0.0, 0.1), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    assert (flange.type, flange.xyz, flange.axis) == ("fixed", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))


def test_chain_leads_outwards(read: Read) -> None:
    urdf = read(ARM)
    assert [joint.name for joint in urdf.chain("base", "tool") or ()] == ["pan", "flange"]
    assert urdf.chain("arm", "arm") == ()
    assert urdf.chain("tool", "base") is None


JOINT = '<joint name="{}" type="fixed"><parent link="{}"/><child link="{}"/></joint>'


def robot(*joints: tuple[str, str, str], links: str = "abcd") -> str:
    lines = [f'<link name="{link}"/>' for link in links]
    return "\n".join(["<robot>", *lines, *(JOINT.format(*joint) for joint in joints), "</robot>"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot><joint", "robot.urdf:1: not valid XML: unclosed token"),
        ("<!DOCTYPE r [<!ENTITY a 'b'>]><robot/>", "robot.urdf:1: has a document type (<!DOCTYPE …>): remove it"),
        ("<mujoco/>", "robot.urdf:1: begins with <mujoco>, must be <robot>"),
        ("<robot/>", "robot.urdf:1: has no <link>; a xacro file that only defines macros is included by another "
         "one: give that"),
        ("<robot>\n<link/></robot>", "robot.urdf:2: <link> has no name"),
        (robot(links="aba"), "robot.urdf:4: a second link named 'a', first in line 2"),
        ("<robot xmlns:xacro='x'>\n<xacro:include filename='a'/></robot>",
         "robot.urdf:2: <xacro:include> is xacro; expand the file first: xacro robot.urdf > FILE"),
        (ARM.replace('type="revolute"', 'type="revolut"'),
         "robot.urdf:5: joint 'pan': unknown type 'revolut', did you mean 'revolute'?"),
        (ARM.replace(' type="fixed"', ""), "robot.urdf:8: <joint> has no type"),
        (ARM.replace('<parent link="base"/>', ""), "robot.urdf:5: joint 'pan' has no <parent link=…/>"),
        (ARM.replace('<parent link="base"/>', '<parent link="bas"/>'),
         "robot.urdf:6: joint 'pan': unknown link 'bas', did you mean 'base'?"),
        (ARM.replace('"flange"', '"pan"'), "robot.urdf:8: a second joint named 'pan', first in line 5"),
        (ARM.replace('xyz="0 0 0.1"', 'xyz="0 0"'), "robot.urdf:6: xyz is '0 0', must be 3 finite numbers"),
        (ARM.replace('rpy="0 0 1"', 'rpy="0 0 nan"'), "robot.urdf:6: rpy is '0 0 nan', must be 3 finite numbers"),
        (ARM.replace('"0 0 2"', '"0 0 0"'),
         "robot.urdf:6: joint 'pan': its axis is zero, must have a direction, e.g. 0 0 1"),
        (robot(("1", "a", "b"), ("2", "c", "b"), ("3", "a", "d")),
         "robot.urdf:7: joints '1' (line 6) and '2' both carry link 'b'; links must form a tree"),
        (robot(("1", "a", "b"), ("2", "b", "d")),
         "robot.urdf:4: link 'c' is not connected: no joint leads to it from 'a'; links must form a "
         "tree: join them by a fixed joint"),
        (robot(("1", "b", "c"), ("2", "c", "d"), ("3", "d", "b")),
         "robot.urdf:6: link 'c' is its own ancestor: c -> d -> b -> c; links must form a tree"),
        (robot(("1", "a", "a"), links="a"),
         "robot.urdf:3: link 'a' is its own ancestor: a -> a; links must form a tree"),
    ],
)  # fmt: skip
def test_wrong_files_are_named_with_their_line(fault: Callable[[str], str], text: str, message: str) -> None:
    assert fault(text) == message


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(KinematicsError, match=r"robot\.urdf: cannot be read: No such file"):
        read_urdf(tmp_path / "robot.urdf")


@settings(max_examples=200)
@given(st.lists(st.tuples(st.sampled_from("abcd"), st.sampled_from("abcd")), max_size=5))
def test_only_trees_are_taken(tmp_path_factory: pytest.TempPathFactory, edges: list[tuple[str, str]]) -> None:
    path = tmp_path_factory.getbasetemp() / "any.urdf"
    path.write_text(robot(*((str(i), *edge) for i, edge in enumerate(edges))))
    carried = [child for _, child in edges]
    reached, waiting = set("abcd") - set(carried), list(set("abcd") - set(carried))
    is_tree = len(waiting) == 1 and len(carried) == len(set(carried))
    while waiting:
        link = waiting.pop()
        inner = {child for parent, child in edges if parent == link} - reached
        reached |= inner
        waiting += inner
    try:
        urdf = read_urdf(path)
    except KinematicsError:
        assert not (is_tree and reached == set("abcd"))
    else:
        assert is_tree
        assert reached == set("abcd")
        assert all(urdf.chain(urdf.root, link) is not None for link in urdf.links)


@settings(max_examples=300)
@given(st.binary(max_size=300) | st.text(max_size=300).map(lambda text: f"<robot>{text}</robot>".encode()))
def test_no_file_is_a_bug(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.urdf"
    path.write_bytes(content)
    with pytest.raises(KinematicsError):
        read_urdf(path)
