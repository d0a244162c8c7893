"""Names and limits of an MJCF, read as plain XML, are those that MuJoCo compiles."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicsError
from ibrobot_kinematics.mjcf_names import read_names

MJCF = """<mujoco>
  <compiler angle="degree"/>
  <default>
    <joint range="-10 10"/>
    <default class="servo"><joint range="-90 90"/><default class="roll"><joint range="-180 180"/></default></default>
  </default>
  <worldbody>
    <body childclass="servo">
      <joint name="pan"/>
      <body><joint name="roll" class="roll"/><joint name="free" range="-1 1" limited="false"/></body>
      <body><joint name="rail" type="slide" range="0 0.3"/></body>
    </body>
    <body><joint name="plain"/></body>
  </worldbody>
</mujoco>
"""


def write(folder: Path, text: str, name: str = "arm.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_an_mjcf_gives_them_by_default_classes_in_degrees(tmp_path: Path) -> None:
    found = read_names(write(tmp_path, MJCF)).limits
    quarter, turn, little = math.radians(90), math.radians(180), math.radians(10)
    wanted = {"pan": (-quarter, quarter), "roll": (-turn, turn), "rail": (0.0, 0.3), "plain": (-little, little)}
    assert found.keys() == wanted.keys()
    for name, ends in wanted.items():
        assert found[name] == pytest.approx(ends)


def test_an_included_file_is_read_in_its_place(tmp_path: Path) -> None:
    world = MJCF[MJCF.index("  <worldbody") : MJCF.index("</mujoco>")]
    write(tmp_path, f"<mujocoinclude>{world}</mujocoinclude>", "world.xml")
    whole = write(tmp_path, MJCF.replace(world, '<include file="world.xml"/>'))
    assert read_names(whole).limits.keys() == {"pan", "roll", "rail", "plain"}
    write(tmp_path, '<mujocoinclude><include file="world.xml"/></mujocoinclude>', "world.xml")
    with pytest.raises(KinematicsError, match=r"world\.xml:1: includes world\.xml a second time"):
        read_names(whole)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco>", r"arm\.xml:1: not valid XML: no element found"),
        ("<robot/>", r"arm\.xml:1: begins with <robot>, must be <mujoco>"),
        (
            '<!DOCTYPE m [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>\n<mujoco>&b;</mujoco>',
            r"arm\.xml:1: has a document type",
        ),
        (
            '<mujoco>\n<worldbody><joint name="a" range="1"/></worldbody></mujoco>',
            r"arm\.xml:2: range is '1', must be 2 finite numbers",
        ),
        (
            '<mujoco>\n<worldbody><joint name="a" range="0 nan"/></worldbody></mujoco>',
            r"arm\.xml:2: range is '0 nan', must be 2 finite numbers",
        ),
        (
            '<mujoco>\n<worldbody><joint name="a" class="b"/></worldbody></mujoco>',
            r"arm\.xml:2: joint 'a': no default class 'b'; the classes are: main",
        ),
        ('<mujoco>\n<include file="gone.xml"/></mujoco>', r"gone\.xml: cannot be read: No such file"),
        pytest.param("<mujoco>" + " " * (16 << 20) + "</mujoco>", r"arm\.xml: is larger than 16 MiB", id="large"),
    ],
)
def test_other_files_are_refused_as_models_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(KinematicsError, match=message):
        read_names(write(tmp_path, text))


def test_deep_nesting_is_read(tmp_path: Path) -> None:
    deep = "<body>" * 20_000 + '<joint name="a" range="0 1"/>' + "</body>" * 20_000
    path = write(tmp_path, f'<mujoco><compiler angle="radian"/><worldbody>{deep}</worldbody></mujoco>')
    assert read_names(path).limits == {"a": (0.0, 1.0)}


CLASSES = ("main", "servo", "small")
RANGES = st.sampled_from(["", 'range="-1 2"', 'range="-0.5 0.25"', 'range="0 3"'])
LIMITED = st.sampled_from(["", "", 'limited="true"', 'limited="false"', 'limited="auto"'])
KINDS = st.sampled_from(["", "", 'type="hinge"', 'type="slide"'])
CLASS = st.sampled_from(["", *(f'class="{name}"' for name in CLASSES)])
CHILD_CLASS = st.sampled_from(["", *(f'childclass="{name}"' for name in CLASSES)])
MASS = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


@st.composite
def models(draw: st.DrawFn) -> str:
    """A chain of bodies, each with a joint, below defaults of three classes."""
    angle = draw(st.sampled_from(["", 'angle="radian"', 'angle="degree"']))
    auto = draw(st.sampled_from(["", 'autolimits="false"']))
    main, servo, small = (f"<joint {draw(RANGES)} {draw(LIMITED)} {draw(KINDS)}/>" for _ in CLASSES)
    nested = draw(st.booleans())
    inner = f'<default class="small">{small}</default>'
    outer = f'<default class="servo">{servo}{inner if nested else ""}</default>{"" if nested else inner}'
    chain = ""
    for i in range(draw(st.integers(1, 4))):
        joint = f'<joint name="j{i}" {draw(CLASS)} {draw(RANGES)} {draw(LIMITED)} {draw(KINDS)}/>'
        chain = f"<body {draw(CHILD_CLASS)}>{MASS}{joint}{chain}</body>"
    return f"<mujoco><compiler {angle} {auto}/><default>{main}{outer}</default><worldbody>{chain}</worldbody></mujoco>"


def compiled(model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    return {model.joint(i).name: tuple(model.jnt_range[i]) for i in range(model.njnt) if model.jnt_limited[i]}


@settings(max_examples=200, deadline=None)
@given(models())
def test_they_are_mujocos(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    try:
        theirs = compiled(mujoco.MjModel.from_xml_string(text))
    except ValueError:  # e.g. limited without a range: MuJoCo refuses it, and config check need not
        return
    ours = read_names(write(tmp_path_factory.mktemp("m"), text)).limits
    assert ours.keys() == theirs.keys()
    for name, ends in theirs.items():
        assert ours[name] == pytest.approx(ends, abs=1e-12)
