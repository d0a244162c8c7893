"""Joint limits as core reads them from an MJCF are those that MuJoCo compiles."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_mujoco.so101 import so101

from ibrobot_core.config.models import read_mjcf

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


def read(path: Path) -> dict[str, tuple[float, float]]:
    return {name: (limits.lower, limits.upper) for name, limits in read_mjcf(path).limits.items()}


@settings(max_examples=200, deadline=None)
@given(models())
def test_they_are_mujocos(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    try:
        theirs = compiled(mujoco.MjModel.from_xml_string(text))
    except ValueError:  # e.g. limited without a range: MuJoCo refuses it, and config check need not
        return
    path = tmp_path_factory.mktemp("m") / "arm.xml"
    path.write_text(text)
    ours = read(path)
    assert ours.keys() == theirs.keys()
    for name, ends in theirs.items():
        assert ours[name] == pytest.approx(ends, abs=1e-12)


def test_so_are_those_of_the_so101() -> None:
    path = so101().description.mjcf
    assert path is not None
    theirs = compiled(mujoco.MjModel.from_xml_path(str(path)))
    ours = read(path)
    assert len(ours) == 6
    for name, ends in ours.items():
        assert ends == pytest.approx(theirs[name], abs=1e-12)
