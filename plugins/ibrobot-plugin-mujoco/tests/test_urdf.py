"""`ibrobot config new` with the URDFs and xacro files that people publish, and with broken ones."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from shutil import rmtree
from subprocess import CompletedProcess
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import mujoco
import pytest
from command_line import run_here
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_mujoco.chains import chains_of
from ibrobot_mujoco.urdf_model import RobotModel, make_model

from ibrobot_core.api import HardwareError
from ibrobot_core.app import load_config

from . import urdf_maker as make

type New = Callable[..., CompletedProcess[str]]


@pytest.fixture
def new(tmp_path: Path) -> New:
    """Writes a URDF, and runs `ibrobot config new arm.yaml --urdf` on it."""

    def run(text: str, *arguments: object, name: str = "made.urdf") -> CompletedProcess[str]:
        (tmp_path / name).write_text(text)
        return run_here("config", "new", tmp_path / "arm.yaml", "--urdf", tmp_path / name, *arguments)

    return run


def refused(done: CompletedProcess[str], folder: Path, *parts: str) -> None:
    """Refused with a message, and nothing left behind."""
    assert done.returncode == 2, done.stdout + done.stderr
    assert "a bug at" not in done.stderr
    for part in parts:
        assert part in done.stderr
    assert not list(folder.glob("*arm*"))


def loads_in_each_mode(path: Path) -> dict[str, tuple[str, ...]]:
    pytest.importorskip("ibrobot_web", reason="needs ibrobot-plugin-web, which a new robot's YAML names")
    config = load_config(path, sim=True)
    for mode in config.control_modes:
        load_config(path, sim=True, mode=mode)
    return dict(config.robot.groups)


# Joints and chains


@pytest.mark.integration
@pytest.mark.parametrize("count", [1, 2, 6, 7, 8, 9, 14, 16])
@pytest.mark.parametrize("fingers", [0, 1])
def test_arm_of_any_number_of_joints_starts_in_each_mode(count: int, fingers: int, tmp_path: Path, new: New) -> None:
    done = new(make.arm(count, fingers=fingers))
    assert done.returncode == 0, done.stderr
    groups = loads_in_each_mode(tmp_path / "arm.yaml")
    assert groups["arm"] == tuple(f"joint_{i}" for i in range(1, count + 1))
    assert len(groups.get("gripper", ())) == fingers


@pytest.mark.integration
@pytest.mark.parametrize(
    ("naming", "names"),
    [
        ("prefixes", ["left", "right"]),
        ("suffixes", ["left", "right"]),
        ("first letters", ["left", "right"]),
        ("numbers", ["arm_1", "arm_2"]),
        ("without a word", ["chain_1", "chain_2"]),
        ("four fingers", ["index", "middle", "ring", "thumb"]),
        ("dots", ["chain_1", "chain_2", "chain_3", "chain_4"]),
    ],
)
def test_arms_in_one_file_are_groups_of_their_own(naming: str, names: list[str], tmp_path: Path, new: New) -> None:
    done = new(make.several(naming, 4, 1, 1))
    assert done.returncode == 0, done.stderr
    groups = loads_in_each_mode(tmp_path / "arm.yaml")
    assert [each for each in groups if not each.endswith(("_arm", "_gripper"))] == [*names, "body"]
    for name, pattern in zip(names, make.ARMS[naming], strict=True):
        assert groups[f"{name}_arm"] == tuple(pattern.format(i) for i in range(1, 5))
        assert groups[f"{name}_gripper"] == (f"finger_{pattern.format(0)}",)
    assert groups["body"] == ("torso_1",)
    assert f"{names[0]} with 4 joints and a gripper" in done.stdout


@pytest.mark.parametrize(("naming", "count", "fingers", "torso"), make.SEVERAL)
def test_each_joint_belongs_to_the_chain_that_it_moves(naming: str, count: int, fingers: int, torso: int) -> None:
    links = {
        each.attrib["name"]: (each.find("parent"), each.find("child"))
        for each in ElementTree.fromstring(make.several(naming, count, fingers, torso)).iter("joint")
    }
    moved_by = {child.attrib["link"]: name for name, (_, child) in links.items() if child is not None}
    parents = {name: moved_by.get(parent.attrib["link"]) for name, (parent, _) in links.items() if parent is not None}
    grips = [name for name in parents if name.startswith("finger")]
    chains = chains_of(parents, grips)
    arms = [each for each in chains if "torso_1" not in each.joints]
    assert len(arms) == len(make.ARMS[naming])
    assert sorted(name for each in chains for name in (*each.joints, *each.gripper)) == sorted(parents)
    for chain, pattern in zip(arms, make.ARMS[naming], strict=True):
        assert chain.joints == tuple(pattern.format(i) for i in range(1, count + 1))
        assert chain.gripper == tuple(f"finger_{pattern.format(i)}" for i in range(fingers))
    assert len({each.name for each in chains}) == len(chains)


@pytest.mark.parametrize("pattern", ["{}", "0{}", "1e{}", "0x{}", "on", "null", "a b{}", "j,{}", "j: {}", "'{}", "é{}"])
def test_names_of_joints_are_texts_in_the_yaml(pattern: str, tmp_path: Path, new: New) -> None:
    done = new(make.arm(1 if "{}" not in pattern else 6, pattern))
    assert done.returncode == 0, done.stderr
    joints = load_config(tmp_path / "arm.yaml", sim=True).robot.joint_names
    assert joints == tuple(pattern.format(i) for i in range(1, len(joints) + 1))


@pytest.mark.integration
def test_a_sliding_axis_of_an_arm_is_not_its_gripper(tmp_path: Path, new: New) -> None:
    text = make.chain(2, "base", "turn_{}") + make.link("z") + make.link("w")
    text += make.joint("z", "link_turn_2", "z", type="prismatic", inside=make.LIMIT.replace("2", "0.1"))
    text += make.joint("w", "z", "w")
    assert new(make.robot(text)).returncode == 0
    assert loads_in_each_mode(tmp_path / "arm.yaml")["arm"] == ("turn_1", "turn_2", "z", "w")


@pytest.mark.integration
def test_a_hand_alone_is_an_arm(tmp_path: Path, new: New) -> None:
    assert new(make.arm(4, "finger_{}")).returncode == 0
    assert len(loads_in_each_mode(tmp_path / "arm.yaml")["arm"]) == 4


# Sizes, masses and units


def mesh_robot(file: str, scale: str = "", **more: Any) -> str:
    shape = f'<mesh filename="{file}"{scale}/>'
    return make.robot(make.link("a", shape, **more) + make.joint("j1", "base", "a") + make.chain(2, "a", "k{}"))


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("", 1.0),
        ('<unit meter="1" name="meter"/>', 1.0),
        ('<unit name="meter"/>', 1.0),
        ('<unit meter="0.001" name="millimeter"/>', 1e-3),
        ('<unit meter="1e-3"/>', 1e-3),
        ('<unit meter="0.01" name="centimeter"/>', 1e-2),
        ('<unit meter="0.1"/>', 0.1),
        ('<unit meter="0.0254" name="inch"/>', 0.0254),
        ('<unit meter="0.3048" name="foot"/>', 0.3048),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_collada_files_in_any_unit_are_metres(unit: str, metres: float, scale: float, tmp_path: Path, new: New) -> None:
    pytest.importorskip("collada")
    size = (0.04 / metres, 0.06 / metres, 0.1 / metres)
    (tmp_path / "box.dae").write_text(make.collada(size, unit))
    done = new(mesh_robot("box.dae", f' scale="{scale} {scale} {scale}"'))
    assert done.returncode == 0, done.stderr
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm_model/model.xml"))
    sides = sorted(2 * model.geom_aabb[model.body("a").geomadr[0], 3:])
    assert sides == pytest.approx([each * scale for each in (0.04, 0.06, 0.1)], rel=1e-4)
    assert ("in other units are converted to metres, as their files say: box.dae" in done.stdout) == (metres != 1)


def test_an_ascii_stl_is_read(tmp_path: Path, new: New) -> None:
    pytest.importorskip("trimesh")
    make.write_stl(tmp_path / "box.stl", (0.04, 0.06, 0.1), ascii=True)
    done = new(mesh_robot("box.stl"))
    assert done.returncode == 0, done.stderr
    assert "converted to STL: box.stl" in done.stdout


@pytest.mark.parametrize("factor", [100, 300, 1000, 1e4])
@pytest.mark.parametrize("mass", [0.0, 0.5])
def test_a_mesh_in_millimetres_is_refused(factor: float, mass: float, tmp_path: Path, new: New) -> None:
    make.write_stl(tmp_path / "box.stl", (0.04 * factor, 0.06 * factor, 0.1 * factor))
    done = new(mesh_robot("box.stl", mass=mass))
    refused(done, tmp_path, "made.urdf:4: link 'a' is ", " m, but the joints reach 0.39 m: are millimetres meant?")


@pytest.mark.parametrize("factor", [20, 40])
def test_a_mesh_in_another_unit_is_shown(factor: float, tmp_path: Path, new: New) -> None:
    make.write_stl(tmp_path / "box.stl", (0.04 * factor, 0.06 * factor, 0.1 * factor))
    done = new(mesh_robot("box.stl"))
    assert done.returncode == 0, done.stderr
    assert "check: link a is " in done.stdout.replace(f"{tmp_path / 'made.urdf'}:4: link 'a'", "link a")
    assert "# - CHECK: " in (tmp_path / "arm.yaml").read_text()


def lever(**more: Any) -> str:
    return make.robot(make.link("a", **more) + make.joint("j1", "base", "a") + make.chain(2, "a", "k{}"))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"mass": 1e5, "inertia": 200.0}, "has a mass of 1e+05 kg: are grams or millimetres meant?"),
        ({"mass": 3.4e9}, "mass"),
        ({"inertia": 1e3}, "are kg mm^2 meant?"),
        ({"inertia": 1e6}, "are kg mm^2 meant?"),
    ],
)
def test_masses_that_do_not_fit_the_joints_are_refused(
    more: dict[str, float], message: str, tmp_path: Path, new: New
) -> None:
    refused(new(lever(**more)), tmp_path, message)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"mass": 300.0, "inertia": 1.0}, "but its effort is 40 N m; the simulation holds the weight all the same."),
        ({"inertia": 0.3}, "are kg mm^2 meant?"),
        ({"mass": 20.0, "inertia": 0.05}, "kg/m^3"),
    ],
)
def test_masses_that_hardly_fit_are_shown(more: dict[str, float], message: str, new: New) -> None:
    done = new(lever(**more))
    assert done.returncode == 0, done.stderr
    assert any(line.startswith("check: ") and message in line for line in done.stdout.splitlines()), done.stdout


def test_an_effort_that_does_not_fit_is_refused(tmp_path: Path, new: New) -> None:
    done = new(lever(mass=50, inertia=0.1).replace('effort="40"', 'effort="0.02"'))
    refused(done, tmp_path, "N m, but its effort is 0.02 N m: masses, inertias and <limit effort=…> do not fit")


def test_a_plausible_arm_causes_no_doubts(new: New) -> None:
    assert "check: " not in new(make.arm(6, fingers=2)).stdout


# Guesses


@pytest.mark.parametrize(
    ("text", "note"),
    [
        (make.link("a", mass=0), "Without mass in the URDF, that of the shapes at 1000 kg/m^3: a."),
        (make.link("a", "", mass=0), "Without mass and shape in the URDF, 0.01 kg: a."),
        (make.link("a", "", mass=0), "The parts that move weigh 0.51 kg"),
        (make.link("a", inertia=0), "With an impossible inertia in the URDF, or none, that of a ball"),
        (make.link("a").replace('ixx="0.001"', 'ixx="1"'), "With an impossible inertia in the URDF"),
        (make.link("a").replace('ixx="0.001"', 'ixx="-1"'), "With an impossible inertia in the URDF"),
        (make.link("a", tag="visual"), "Without collision shapes in the URDF, those for the eye are used: a."),
        (make.link("a", '<box size="0 0 0"/>'), "Shapes without any size are left out: a."),
        (make.link("a", '<cylinder radius="0" length="1"/>'), "Shapes without any size are left out: a."),
        (make.link("a", '<sphere radius="0"/>'), "Shapes without any size are left out: a."),
        (make.link("a", '<mesh filename="x.stl" scale="0 0 0"/>'), "Shapes without any size are left out: a."),
    ],
)
def test_guesses_are_stated(text: str, note: str, tmp_path: Path, new: New) -> None:
    done = new(make.robot(text + make.joint("j", "base", "a") + make.chain(1, "a", "k{}")))
    assert done.returncode == 0, done.stderr
    assert f"note: {note}" in done.stdout
    assert f"# - {note}" in (tmp_path / "arm.yaml").read_text()


@pytest.mark.parametrize(
    ("joint", "note"),
    [
        (make.joint("j", "base", "a", inside=""), "Without end in the URDF, here one turn to each side: j."),
        (make.joint("j", "base", "a", inside=""), "The URDF states no effort for j: 20 N m (or N)."),
        (make.joint("j", "base", "a", inside=""), "The URDF states no speed for j: 1 rad/s (or m/s)."),
        (make.joint("j", "base", "a", type="floating", inside=""), "The base stands still, whatever moves it"),
        (make.joint("j", "base", "a", type="planar", inside=""), "The base stands still, whatever moves it"),
        (make.joint("wheel", "base", "a", type="continuous", inside=""), "Wheels do not turn: wheel."),
        (make.joint("j", "base", "a", inside='<limit effort="1" velocity="1"/>'), "Fixed, since the upper"),
    ],
)  # fmt: skip
def test_guesses_about_joints_are_stated(joint: str, note: str, new: New) -> None:
    done = new(make.robot(make.link("a") + joint + make.chain(2, "a", "k{}")))
    assert done.returncode == 0, done.stderr
    assert f"note: {note}" in done.stdout


def test_an_effort_that_is_guessed_holds_the_arm(tmp_path: Path, new: New) -> None:
    heavy = make.link("a", mass=50, inertia=0.5) + make.joint("j", "base", "a", inside="")
    done = new(make.robot(heavy + make.chain(2, "a", "k{}")))
    assert "The URDF states no effort for j (" in done.stdout
    assert "check: joint" not in done.stdout


# Content that others read


@pytest.mark.parametrize(
    "extra",
    [
        "<sensor:camera name='x'/>",
        "<gazebo reference='a'><sensor:ray xmlns:x='y'/></gazebo>",
        "<ros2_control name='r' type='system'><joint name='joint_1'/></ros2_control>",
        "<transmission name='t'><joint name='joint_1'/><actuator name='m'/></transmission>",
        "<material name='m'><color rgba='a b c d'/></material>",
        "<!-- é ${not} $(find x) -->",
        "<link_of_another_tool/><robot name='inner'><link name='base'/></robot>",
        "<gazebo><plugin filename='x'>&lt;xml&gt;</plugin></gazebo>",
    ],
)
def test_elements_of_other_programs_are_ignored(extra: str, new: New) -> None:
    done = new(make.arm(3).replace("</robot>", f"{extra}</robot>"))
    assert done.returncode == 0, done.stderr


GOOD = make.link("a") + make.joint("j", "base", "a") + make.link("b") + make.joint("k", "a", "b")
WRONG = {
    "effort below zero": (('effort="40"', 'effort="-5"'), "joint 'j': its effort is -5, must not be below zero"),
    "velocity below zero": (('velocity="2"', 'velocity="-1"'), "joint 'j': its velocity is -1"),
    "limits swapped": (
        ('lower="-2" upper="2"', 'lower="2" upper="-2"'),
        "joint 'j': its lower limit, 2, is above the upper one, -2: swap them",
    ),
    "limit is a word": (('lower="-2"', 'lower="low"'), "lower is 'low', must be 1 finite number"),
    "limit is not finite": (('upper="2"', 'upper="nan"'), "upper is 'nan', must be 1 finite number"),
    "huge": (('upper="2"', 'upper="1e300"'), "upper is 1e+300, must be within"),
    "mass below zero": (('mass value="0.5"', 'mass value="-1"'), "link 'a': its mass is -1 kg"),
    "size below zero": (("0.04 0.04 0.1", "0.04 -0.04 0.1"), "link 'a': <box> has a size below zero: -0.04"),
    "two sizes": (("0.04 0.04 0.1", "0.04 0.04"), "size is '0.04 0.04', must be 3 finite numbers"),
    "no size": ((' size="0.04 0.04 0.1"', ""), "link 'a': <box> has no size"),
    "unknown shape": (("<box", "<cone"), "link 'a': unknown shape <cone>; the shapes are: box, cylinder"),
    "no geometry": (("geometry", "geom"), "link 'a': <collision> has no <geometry>"),
    "axis": (('xyz="0 1 0"', 'xyz="0 0 0"'), "joint 'j': its axis is zero, must have a direction, e.g. 0 0 1"),
    "type": (('type="revolute"', 'type="ball"'), "joint 'j': unknown type 'ball'; known: revolute, continuous"),
    "sliding without limits": (
        ('type="revolute"', 'type="prismatic"', make.LIMIT, ""),
        "joint 'j' slides, and has no limits: add <limit lower=",
    ),
    "floating in the arm": (
        ('name="k" type="revolute"', 'name="k" type="floating"'),
        "joint 'k' is floating; only the base may have such a joint",
    ),
    "unknown parent": (('parent link="a"', 'parent link="aa"'), "joint 'k': unknown link 'aa', did you mean 'a'?"),
    "no child": (('<child link="a"/>', ""), "joint 'j' has no <child link="),
    "link without a name": (('link name="a"', "link"), "<link> has no name"),
    "two links of a name": (('link name="b"', 'link name="a"'), "a second link named 'a', first in line 4"),
    "two joints of a name": (('name="k"', 'name="j"'), "a second joint named 'j', first in line"),
    "two parents": (
        ('<parent link="a"/><child link="b"/>', '<parent link="base"/><child link="a"/>'),
        "joints 'j' (line 5) and 'k' both carry link 'a'; links must form a tree",
    ),
    "a circle": (
        ('parent link="base"', 'parent link="b"'),
        "link 'a' is its own ancestor: a -> b -> a; links must form a tree",
    ),
    "two roots": (
        ('name="base"/>', 'name="base"/><link name="c"/>'),
        "link 'c' is not connected: no joint leads to it from 'base'",
    ),
    "itself": (
        ('parent link="base"', 'parent link="a"'),
        "link 'a' is its own ancestor: a -> a; links must form a tree",
    ),
    "mimics none": (("</joint>", '<mimic joint="z"/></joint>'), "mimics 'z', unknown; it has: j, k"),
    "mimics itself": (("</joint>", '<mimic joint="j"/></joint>'), "joint 'j' mimics itself"),
    "mimics nothing": (("</joint>", "<mimic/></joint>"), "joint 'j': <mimic> names no joint"),
    "a variable": (('"base"', '"${HOME}"'), "which begins a variable in a robot YAML"),
    "no links": ((GOOD, "", '<link name="base"/>', ""), "has no <link>; a xacro file that only defines macros"),
    "world in the arm": (('"a"', '"world"'), "the link 'world' must be the one without a parent joint"),
    "document type": (("<robot", "<!DOCTYPE robot><robot"), "has a document type"),
    "network": (('<box size="0.04 0.04 0.1"/>', '<mesh filename="https://x/y.stl"/>'), "download it"),
    "no mesh": (('<box size="0.04 0.04 0.1"/>', "<mesh/>"), "link 'a': <mesh> has no filename"),
    "encoding": (('version="1.0"', 'version="1.0" encoding="big5"'), "made.urdf:1: unknown encoding: use UTF-8"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_a_faulty_urdf_is_an_error_at_its_line(
    changes: tuple[str, ...], message: str, tmp_path: Path, new: New
) -> None:
    text = make.robot(GOOD)
    for old, other in zip(changes[::2], changes[1::2], strict=True):
        assert old in text
        text = text.replace(old, other, 1 if old not in ("geometry", '"a"', '"base"') else -1)
    refused(new(text), tmp_path, "made.urdf:", message)


def test_a_name_of_another_place_is_an_error(tmp_path: Path, new: New) -> None:
    (tmp_path / "made.urdf").write_text(make.arm(2))
    done = run_here("config", "new", tmp_path / "none/arm.yaml", "--urdf", tmp_path / "made.urdf")
    assert done.returncode != 0
    assert "none/arm.yaml cannot be written: No such file or directory" in done.stderr


@pytest.mark.parametrize("offset", [-0.5, -0.2])
def test_a_robot_below_its_base_stands_higher(offset: float, tmp_path: Path, new: New) -> None:
    done = new(make.arm(2).replace('xyz="0 0 0.13"', f'xyz="0 0 {offset}"', 1))
    assert done.returncode == 0, done.stderr
    assert "The base stands " in done.stdout


# xacro

XACRO = '<robot name="made" xmlns:xacro="http://www.ros.org/wiki/xacro">'
MACRO = f"""{XACRO}<xacro:macro name="arm" params="prefix reach">
<link name="${{prefix}}base"/>
{make.link("${prefix}a", "${shape}").replace("${shape}", make.BOX)}
<joint name="${{prefix}}j" type="revolute"><parent link="${{prefix}}base"/><child link="${{prefix}}a"/>
<origin xyz="0 0 ${{reach}}"/><axis xyz="0 1 0"/>{make.LIMIT}</joint>
</xacro:macro></robot>
"""
MAIN = f"""{XACRO}
<xacro:arg name="reach" default="0.13"/>
<xacro:include filename="$(find arm_description)/urdf/arm.xacro"/>
<xacro:arm prefix="$(arg prefix)" reach="$(arg reach)"/>
</robot>
"""


@pytest.fixture(params=["above", "beside", "beside the repository", "package.xml", "--package", "ament"])
def layout(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[str]]:
    """Folder for the main file, and arguments: the ways in which a package can be there."""
    pytest.importorskip("xacro")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    work = tmp_path / "work"
    match request.param:
        case "above":
            package, main = work / "arm_description", work / "arm_description/robots"
        case "beside":
            package, main = work / "arm_description", work / "bringup/urdf"
        case "beside the repository":
            package, main = work / "src/arm_description", work / "src/demo/example_1/description/urdf"
        case "package.xml":
            package, main = work / "cloned", work / "demo"
            package.mkdir(parents=True)
            (package / "package.xml").write_text("<package><name>arm_description</name></package>")
        case "--package":
            package, main = tmp_path / "elsewhere/x", work
        case _:
            package, main = tmp_path / "ros/share/arm_description", work
            monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ros"))
    (package / "urdf").mkdir(parents=True)
    (package / "urdf/arm.xacro").write_text(MACRO)
    main.mkdir(parents=True, exist_ok=True)
    return main, ["--package", f"arm_description={package}"] if request.param == "--package" else []


def test_xacro_files_find_their_packages(layout: tuple[Path, list[str]], tmp_path: Path) -> None:
    folder, arguments = layout
    (folder / "main.urdf.xacro").write_text(MAIN)
    done = run_here(
        "config", "new", tmp_path / "arm.yaml", "--urdf", folder / "main.urdf.xacro", *arguments,
        "--xacro-arg", "prefix=my_", "--xacro-arg", "reach:=0.2",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert load_config(tmp_path / "arm.yaml", sim=True).robot.joint_names == ("my_j",)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm_model/model.xml"))
    assert model.body("my_a").pos[2] == pytest.approx(0.2)


FAULTS = {
    "argument": (MAIN, (), "main.xacro:4: the argument prefix has no default: give --xacro-arg prefix=VALUE"),
    "typo": (
        MAIN,
        ("--xacro-arg", "prefix=a", "--xacro-arg", "prefx=a"),
        "main.xacro has no argument 'prefx', did you mean 'prefix'?",
    ),
    "package": (
        MAIN.replace("find arm_d", "find d"),
        ("--xacro-arg", "prefix=a"),
        "main.xacro:3: no folder of the package 'description' is above or beside",
    ),
    "file": (
        MAIN.replace("arm.xacro", "leg.xacro"),
        ("--xacro-arg", "prefix=a"),
        "main.xacro:3: ",
        "leg.xacro cannot be read: No such file or directory",
    ),
    "expression": (MAIN.replace("$(arg prefix)", "${1 +}"), (), "main.xacro:4: xacro cannot expand it: "),
    "variable": (MAIN.replace("$(arg prefix)", "${nothing}"), (), "main.xacro:4: ", "'nothing' is not defined"),
    "macro": (MAIN.replace("<xacro:arm ", "<xacro:leg "), (), "main.xacro:4: ", "unknown macro name: xacro:leg"),
    "parameter": (MAIN.replace(' prefix="$(arg prefix)"', ""), (), "main.xacro:4: ", "Undefined parameters [prefix]"),
    "not XML": (MAIN.replace("</robot>", ""), (), "main.xacro:6: not valid XML"),
    "no namespace": ("<robot name='a'><xacro:arm/></robot>", (), "main.xacro:1: not valid XML: unbound prefix"),
    "only macros": (MACRO, (), "main.xacro:1: has no <link>; a xacro file that only defines macros"),
    "in the macro": (
        MAIN.replace("$(arg prefix)", "a").replace("$(arg reach)", "far"),
        (),
        "arm.xacro:6: xyz is '0 0 far', must be 3 finite numbers",
    ),
    "recursion": (
        f"{XACRO}<xacro:macro name='m'><xacro:m/></xacro:macro><xacro:m/></robot>",
        (),
        "main.xacro:1: includes or macros that call themselves without end",
    ),
    "itself": (
        f"{XACRO}<xacro:include filename='main.xacro'/></robot>",
        (),
        "main.xacro:1: includes or macros that call themselves without end",
    ),
    "no xacro": (make.arm(2), ("--xacro-arg", "a=b"), "main.xacro is not a xacro file, so it has no argument 'a'"),
    "no value": (MAIN, ("--xacro-arg", "a"), "expected NAME=VALUE, got 'a'"),
}


@pytest.mark.parametrize("case", FAULTS.values(), ids=FAULTS)
def test_a_faulty_xacro_file_is_an_error_at_its_line(case: tuple[object, ...], tmp_path: Path, new: New) -> None:
    pytest.importorskip("xacro")
    text, arguments, *messages = case
    (tmp_path / "arm_description/urdf").mkdir(parents=True)
    (tmp_path / "arm_description/urdf/arm.xacro").write_text(MACRO)
    done = new(str(text), *arguments, name="main.xacro")  # type: ignore[misc]
    assert done.returncode == 2, done.stdout + done.stderr
    assert "a bug at" not in done.stderr
    for message in messages:
        assert str(message) in done.stderr
    assert not (tmp_path / "arm.yaml").exists()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["arm_description", "main.xacro"]


# Anything at all

WORDS = [
    "", " ", "0", "-1", "1", "1e9", "1e400", "nan", "-inf", "0 0 0", "1 2", "1 2 3 4", "base", "a", "world", "x" * 300,
    "fixed", "prismatic", "continuous", "floating", "package://", "package://x/y", "file:///", "..", "/", "é", "\u2028",
    "${x}", "$(find x)", "0x1", "1_0", "\u0661", "-0", "1e-30", "0.5", "3", "joint_1", "link_joint_2", "k.stl",
]  # fmt: skip
TAGS = ["link", "joint", "limit", "mimic", "origin", "mass", "inertia", "box", "mesh", "sphere", "robot", "axis", "x"]


def mutated(seed: int) -> bytes:
    """A URDF with a few changes by chance: of values, elements, or bytes."""
    chance = random.Random(seed)
    text = chance.choice([make.arm(3, fingers=2), make.several("prefixes", 3, 1, 1), make.robot(GOOD)])
    root = ElementTree.fromstring(text)
    for _ in range(chance.randint(1, 4)):
        elements = [(parent, child) for parent in root.iter() for child in parent]
        parent, child = chance.choice(elements)
        match chance.randrange(7):
            case 0 | 1 | 2 if child.attrib:
                child.set(chance.choice(list(child.attrib)), chance.choice(WORDS))
            case 3:
                parent.remove(child)
            case 4:
                parent.append(child)
            case 5:
                child.tag = chance.choice(TAGS)
            case _:
                child.set(chance.choice(["name", "type", "xyz", "value", "joint", "scale"]), chance.choice(WORDS))
    data = bytearray(ElementTree.tostring(root))
    if chance.random() < 0.2:
        for _ in range(chance.randint(1, 3)):
            data[chance.randrange(len(data))] = chance.randrange(256)
    return bytes(data)


def read(data: bytes) -> RobotModel | None:
    """The model of a file; None if it is refused, as wrong input."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.urdf").write_bytes(data)
        make.write_stl(folder / "k.stl", (0.04, 0.06, 0.1))
        try:
            model = make_model(folder / "a.urdf", folder / "model", {})
        except HardwareError:
            model = None
        assert (folder / "model").exists() == (model is not None)
        if model is None:
            return None
        rmtree(folder / "model")
        return model


@settings(max_examples=200)
@given(st.integers(0, 2**32))
def test_no_urdf_is_a_bug(seed: int) -> None:
    model = read(mutated(seed))
    if model is not None:
        assert all(each.lower < each.upper for each in model.joints)
        assert len(model.home) == len(model.joints)


@settings(max_examples=100)
@given(st.binary(max_size=200) | st.text(max_size=100).map(lambda text: f"<robot>{text}</robot>".encode()))
def test_no_file_is_a_bug(data: bytes) -> None:
    assert read(data) is None
