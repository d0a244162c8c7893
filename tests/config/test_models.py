"""Limits of joints in URDF and MJCF models, and a robot YAML that goes beyond them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from ibrobot_core.config import RobotConfig
from ibrobot_core.config.models import DescriptionModel, ModelError, read_mjcf, read_urdf
from ibrobot_core.errors import ConfigError

Load = Callable[..., RobotConfig]

URDF = """<?xml version="1.0"?>
<robot name="arm">
  <joint name="pan" type="revolute"><limit lower="-1.0" upper="1.0" effort="1" velocity="1"/></joint>
  <joint name="lift" type="revolute">
    <limit lower="-1.5" upper="1.5" effort="1" velocity="1"/>
  </joint>
  <joint name="wheel" type="continuous"/>
</robot>
"""
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

WHOLE = MJCF.replace(
    '<joint name="plain"/>',
    '<joint name="plain"/><joint name="lift" limited="false"/><joint name="grip" limited="false"/>',
)
"""With all joints of the robot."""


def limits_of(model: DescriptionModel) -> dict[str, tuple[float, float]]:
    return {name: (limits.lower, limits.upper) for name, limits in model.limits.items()}


def write(folder: Path, text: str, name: str = "arm.xml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_urdf_gives_the_limits_of_joints_that_have_some(tmp_path: Path) -> None:
    found = read_urdf(write(tmp_path, URDF))
    assert limits_of(found) == {"pan": (-1.0, 1.0), "lift": (-1.5, 1.5)}
    assert found.limits["lift"].place == "arm.xml:5"


def test_an_mjcf_gives_them_by_default_classes_in_degrees(tmp_path: Path) -> None:
    found = limits_of(read_mjcf(write(tmp_path, MJCF)))
    quarter, turn, little = math.radians(90), math.radians(180), math.radians(10)
    wanted = {"pan": (-quarter, quarter), "roll": (-turn, turn), "rail": (0.0, 0.3), "plain": (-little, little)}
    assert found.keys() == wanted.keys()
    for name, ends in wanted.items():
        assert found[name] == pytest.approx(ends)


def test_an_included_file_is_read_in_its_place(tmp_path: Path) -> None:
    world = MJCF[MJCF.index("  <worldbody") : MJCF.index("</mujoco>")]
    write(tmp_path, f"<mujocoinclude>{world}</mujocoinclude>", "world.xml")
    whole = write(tmp_path, MJCF.replace(world, '<include file="world.xml"/>'))
    assert read_mjcf(whole).limits.keys() == {"pan", "roll", "rail", "plain"}
    write(tmp_path, '<mujocoinclude><include file="world.xml"/></mujocoinclude>', "world.xml")
    with pytest.raises(ModelError, match=r"world\.xml:1: includes world\.xml a second time"):
        read_mjcf(whole)


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
    with pytest.raises(ModelError, match=message):
        read_mjcf(write(tmp_path, text))


def test_deep_nesting_is_read(tmp_path: Path) -> None:
    deep = "<body>" * 20_000 + '<joint name="a" range="0 1"/>' + "</body>" * 20_000
    path = write(tmp_path, f'<mujoco><compiler angle="radian"/><worldbody>{deep}</worldbody></mujoco>')
    assert limits_of(read_mjcf(path)) == {"a": (0.0, 1.0)}


def problems(load_text: Load, text: str) -> list[tuple[int, str, str]]:
    with pytest.raises(ConfigError) as refused:
        load_text(text)
    return [(problem.line, problem.path, problem.message) for problem in refused.value.problems]


@pytest.fixture
def modelled(base: str, tmp_path: Path) -> str:
    """The robot of these tests with a URDF: pan may turn a radian each way there."""
    write(tmp_path, URDF, "arm.urdf")
    return base.replace("    poses:", "    urdf: arm.urdf\n    poses:")


def test_limits_in_degrees_are_refused_with_the_radians(load_text: Load, modelled: str) -> None:
    text = modelled.replace("name: pan, lower: -1.0", "name: pan, lower: -57.3")
    assert text != modelled
    ((line, path, message),) = problems(load_text, text)
    assert line == next(i for i, each in enumerate(text.splitlines(), 1) if "-57.3" in each)
    assert path == "robot.joints.pan.lower"
    assert message == (
        "-57.3 rad is beyond the model's limits, -1 to 1 rad (arm.urdf:3); were degrees meant? "
        "-57.3 degrees are -1.0001 rad"
    )


def test_a_limit_a_little_beyond_the_model_needs_a_word(load_text: Load, modelled: str) -> None:
    text = modelled.replace("name: pan, lower: -1.0", "name: pan, lower: -1.2")
    ((_, path, message),) = problems(load_text, text)
    assert path == "robot.joints.pan.lower"
    assert message.endswith("narrow it, or set beyond_model: true where pan can go there")
    allowed = text.replace("name: pan,", "name: pan, beyond_model: true,")
    assert load_text(allowed).robot.joints[0].lower == -1.2
    rounded = modelled.replace("name: pan, lower: -1.0", "name: pan, lower: -1.005")
    assert load_text(rounded).robot.joints[0].lower == -1.005


def test_of_two_models_the_wider_one_counts(load_text: Load, modelled: str, tmp_path: Path) -> None:
    text = modelled.replace("name: pan, lower: -1.0", "name: pan, lower: -1.2")
    text = text.replace("    urdf:", "    mjcf: arm.xml\n    urdf:")
    write(tmp_path, WHOLE)
    assert load_text(text).robot.joints[0].lower == -1.2
    ((_, _, message),) = problems(load_text, text.replace("lower: -1.2", "lower: -1.7"))
    assert "-1.5708 to 1.5708 rad (arm.xml:9)" in message


def test_mjcf_without_a_joint_of_the_robot_is_refused_on_hardware(
    load_text: Load, modelled: str, tmp_path: Path
) -> None:
    write(tmp_path, WHOLE.replace('name="pan"', 'name="pann"'))
    text = modelled.replace("    urdf:", "    mjcf: arm.xml\n    urdf:")
    ((_, path, message),) = problems(load_text, text)
    assert (path, message) == ("robot.description.mjcf", "the model has no joint 'pan', did you mean 'pann'?")


def test_a_model_that_cannot_be_read_is_a_fault_of_its_key(load_text: Load, modelled: str, tmp_path: Path) -> None:
    write(tmp_path, URDF.replace("</robot>", ""), "arm.urdf")
    ((_, path, message),) = problems(load_text, modelled)
    assert path == "robot.description.urdf"
    assert "arm.urdf:9: not valid XML: no element found" in message


def test_a_tip_that_no_model_has_is_refused(load_text: Load, modelled: str, tmp_path: Path) -> None:
    write(tmp_path, URDF.replace("</robot>", '<link name="gripper_tip"/></robot>'), "arm.urdf")
    text = modelled.replace("    urdf:", "    tip: griper_tip\n    urdf:")
    ((_, path, message),) = problems(load_text, text)
    assert path == "robot.description.tip"
    assert message == "unknown link 'griper_tip', did you mean 'gripper_tip'?"
    assert load_text(text.replace("griper", "gripper")).robot.description.tip == "gripper_tip"
    write(tmp_path, WHOLE.replace("</body>\n  </worldbody>", '<site name="griper_tip"/></body>\n  </worldbody>'))
    assert load_text(text.replace("    urdf:", "    mjcf: arm.xml\n    urdf:")).robot.description.tip == "griper_tip"
