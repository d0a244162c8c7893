"""All engines place the links of a robot where MuJoCo does."""

from __future__ import annotations

import struct
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from ibrobot_kinematics.frames import transform
from ibrobot_kinematics.mjcf import placement, read_mjcf, several_arms
from ibrobot_kinematics.poses import homogeneous, matrix
from ibrobot_kinematics.rotations import exp
from ibrobot_kinematics.urdf import Urdf, read_urdf
from ibrobot_mujoco.urdf_model import make_model
from ibrobot_planning.world.arm import read_arm
from ibrobot_web.scene import make_scene

from ibrobot_core.api import Pose, Vector
from ibrobot_core.app import installed_plugins, load_config

pytestmark = pytest.mark.integration

CLOSE = 1e-9
"""[m], and for each element of a rotation. Products of the same matrices in another order differ by 1e-15."""
SIX_DIGITS = 1e-5
"""As above for files that MuJoCo writes: it rounds each number to six digits, and up to five links add up."""
ROOT = Path(__file__).parents[2]
SIZE = (0.02, 0.03, 0.05)


def by_mujoco(model: mujoco.MjModel, positions: dict[str, float]) -> dict[str, Vector]:
    """Body -> its pose, shape (4, 4); joints that are not named stay at their reference."""
    state = mujoco.MjData(model)
    for name, value in positions.items():
        state.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, state)
    return {model.body(i).name: homogeneous(state.xmat[i].reshape(3, 3), state.xpos[i]) for i in range(1, model.nbody)}


def by_the_page(scene: dict[str, Any], positions: dict[str, float]) -> dict[str, Vector]:
    """The same from what the page gets, as `scene.js` places the bodies."""
    poses: list[Vector] = []
    for body in scene["bodies"]:
        placed = poses[body["parent"]] if body["parent"] >= 0 else np.eye(4)
        placed = placed @ placement(body["pos"], body["quat"])
        for joint in body["joints"]:
            way = (positions.get(joint["name"], joint["ref"]) - joint["ref"]) * np.array(joint["axis"])
            anchor = homogeneous(np.eye(3), np.array(joint["pos"]))
            moved = homogeneous(np.eye(3), way) if joint["type"] == "slide" else homogeneous(exp(way), np.zeros(3))
            placed = placed @ anchor @ moved @ np.linalg.inv(anchor)
        poses.append(placed)
    return {body["name"]: pose for body, pose in zip(scene["bodies"], poses, strict=True)}


def samples(limits: dict[str, tuple[float, float]], count: int) -> list[dict[str, float]]:
    rng = np.random.default_rng(0)
    return [{name: rng.uniform(*ends) for name, ends in limits.items()} for _ in range(count)]


def shapes(model: mujoco.MjModel) -> list[tuple[Any, ...]]:
    """What can collide: link, place, and size or mesh."""
    found = []
    for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
        place = (*model.geom_pos[geom], *model.geom_quat[geom])
        mesh = int(model.geom_dataid[geom])
        first, count = (int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])) if mesh >= 0 else (0, 0)
        shape = model.mesh_vert[first : first + count].tobytes() or tuple(model.geom_size[geom])
        found.append((model.body(int(model.geom_bodyid[geom])).name, int(model.geom_type[geom]), place, shape))
    return found


def compare(path: Path, tip: str | None, joints: tuple[str, ...], count: int = 6) -> int:
    """Compare the engines at random configurations; returns the number of compared links."""
    model = mujoco.MjModel.from_xml_path(str(path))
    colliding = read_mjcf(path).spec.copy()
    for name in read_mjcf(path).only_visible:
        for geom in colliding.body(name).geoms:
            geom.contype = 1
    assert shapes(read_mjcf(path).solid) == shapes(colliding.compile())
    arm = read_arm(path, joints)
    scene = make_scene({"mjcf": str(path), "urdf": None, "tip": tip or ""})
    assert scene["problem"] == ""
    limits = {name: tuple(model.joint(name).range) for name in joints}
    if tip is not None:
        chain = read_mjcf(path).chain(tip, joints)
    compared = 0
    for positions in samples(limits, count):
        expected = by_mujoco(model, positions)
        q = np.array([positions[name] for name in joints])
        page = by_the_page(scene, positions)
        for link, pose in expected.items():
            np.testing.assert_allclose(arm.link_pose(link, q), pose, atol=CLOSE)
            np.testing.assert_allclose(page[link], pose, atol=CLOSE)
            compared += 1
        if tip is not None:
            site = model.site(tip)
            on = expected[model.body(int(site.bodyid[0])).name] @ placement(site.pos, site.quat)
            tool = chain.forward(q)
            np.testing.assert_allclose(homogeneous(tool.rotation, tool.position), on, atol=CLOSE)
    return compared


def bundled() -> dict[str, Any]:
    """Robot YAMLs of this repository, those with one arm and those with several."""
    known = installed_plugins()
    return {
        path.stem: load_config(path, sim=True, registry=known) for path in sorted((ROOT / "configs").glob("*.yaml"))
    }


def test_bundled_robots() -> None:
    compared = {}
    for name, config in bundled().items():
        described = config.robot.description
        if described.arms:
            joints = tuple(
                dict.fromkeys(each.removeprefix(described.arm_of(each)) for each in config.robot.joint_names)
            )
        else:
            joints = config.robot.joint_names
        compared[name] = compare(described.mjcf, described.tip, joints)
    assert len(compared) == 7
    assert min(compared.values()) >= 6 * 7


def test_robots_of_several_arms_on_the_page() -> None:
    described = bundled()["bi_so101"].robot.description
    model = several_arms(described.mjcf, described.arms).compile()
    scene = make_scene({"mjcf": str(described.mjcf), "tip": described.tip, "arms": described.arms})
    names = [model.joint(i).name for i in range(model.njnt)]
    for positions in samples({name: tuple(model.joint(name).range) for name in names}, 6):
        page = by_the_page(scene, positions)
        for link, pose in by_mujoco(model, positions).items():
            np.testing.assert_allclose(page[link], pose, atol=CLOSE)


def test_the_urdf_of_the_so101() -> None:
    check_tf(bundled()["so101"].robot.description.urdf)


def by_tf(urdf: Urdf, positions: dict[str, float]) -> dict[str, Vector]:
    """Link -> its pose in the root, as the frames on `/tf` say."""
    poses = {urdf.root: np.eye(4)}
    for joint in urdf.outwards:
        message = transform(joint, positions.get(joint.name, 0.0), 0)
        poses[joint.child] = poses[joint.parent] @ matrix(Pose(message.translation, message.rotation))
    return poses


def check_tf(path: Path) -> None:
    """Compare `/tf` with MuJoCo's own reading of a URDF."""
    urdf = read_urdf(path)
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False
    model = spec.compile()
    limits = {joint.name: joint.limits or (-3.0, 3.0) for joint in urdf.joints if joint.type != "fixed"}
    for positions in samples(limits, 6):
        poses = by_tf(urdf, positions)
        for link, pose in by_mujoco(model, positions).items():
            np.testing.assert_allclose(poses[link], pose, atol=CLOSE)


def write_mesh(path: Path) -> None:
    """A box as a binary STL file."""
    corners = list(product(*((-each / 2, each / 2) for each in SIZE)))
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    data = b"".join(struct.pack("<12fH", 0, 0, 0, *(v for i in face for v in corners[i]), 0) for face in faces)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", 12) + data)


LENGTH = st.integers(-300, 300).map(lambda value: value / 1000)
TRIPLE = st.tuples(LENGTH, LENGTH, LENGTH).map(lambda xyz: " ".join(map(str, xyz)))
TURN = st.tuples(*[st.integers(-180, 180)] * 3)
AXIS = st.sampled_from(["1 0 0", "0 1 0", "0 0 -1", "1 2 0.5", "-0.3 0.1 1"])


@st.composite
def mjcfs(draw: st.DrawFn) -> tuple[dict[str, str], tuple[str, ...]]:
    """The files of an arm with defaults, includes and compiler options, and the names of its joints."""
    radian = draw(st.booleans())
    unit = np.pi / 180 if radian else 1.0
    sequence = draw(st.sampled_from(["xyz", "XYZ", "zyx", "ZYZ", "yxZ"]))
    meshes = draw(st.sampled_from(["", "shapes", "assets/meshes"]))

    def turn() -> str:
        return " ".join(f"{angle * unit:.12g}" for angle in draw(TURN))

    def number(degrees: float) -> str:
        return f"{degrees * unit:.12g}"

    joints: list[str] = []
    ends: list[str] = []
    text = ""
    for i in range(draw(st.integers(1, 5))):
        childclass = draw(st.sampled_from(["", ' childclass="swing"', ' childclass="drawer"']))
        framed = draw(st.booleans())
        text += f'<frame pos="{draw(TRIPLE)}" euler="{turn()}">' if framed else ""
        text += f'<body name="b{i}" pos="{draw(TRIPLE)}" euler="{turn()}"{childclass}>'
        looks = '<geom type="mesh" mesh="box" contype="0" conaffinity="0" pos="0 0 0.1"/>'
        mesh, box = '<geom type="mesh" mesh="box"/>', '<geom type="box" size="0.01 0.02 0.03"/>'
        text += draw(st.sampled_from([mesh, box, looks, mesh + looks, looks + box]))
        for _ in range(draw(st.integers(0 if i else 1, 2))):
            name = f"j{len(joints)}"
            joints.append(name)
            class_ = draw(st.sampled_from(["", ' class="swing"', ' class="drawer"']))
            text += f'<joint name="{name}"{class_} axis="{draw(AXIS)}" pos="{draw(TRIPLE)}"/>'
        ends.append("</body></frame>" if framed else "</body>")
    text += f'<site name="tip" pos="{draw(TRIPLE)}" euler="{turn()}"/>' + "".join(reversed(ends))
    reference = draw(st.sampled_from([0, 20]))
    defaults = (
        f'<default><joint range="{number(-150)} {number(150)}" armature="1"/>'
        f'<default class="swing"><joint range="{number(-90)} {number(60)}" ref="{number(reference)}"/></default>'
        '<default class="drawer"><joint type="slide" range="-0.5 0.5" ref="0.1"/></default></default>'
    )
    directory = f' meshdir="{meshes}"' if meshes else ""
    compiler = f'<compiler angle="{"radian" if radian else "degree"}" eulerseq="{sequence}"{directory}/>'
    assets = '<asset><mesh name="box" file="box.stl"/></asset>'
    files = {f"{meshes}/box.stl": ""}
    parts = {"defaults": defaults, "assets": assets, "arm": f"<worldbody>{text}</worldbody>"}
    whole = compiler
    for name, part in parts.items():
        if draw(st.booleans()):
            files[f"{name}.xml"] = f"<mujocoinclude>{part}</mujocoinclude>"
            whole += f'<include file="{name}.xml"/>'
        else:
            whole += part
    return {**files, "whole.xml": f"<mujoco>{whole}</mujoco>"}, tuple(draw(st.permutations(joints)))


@settings(max_examples=50, deadline=None)
@given(mjcfs())
def test_generated_mjcfs(
    tmp_path_factory: pytest.TempPathFactory, drawn: tuple[dict[str, str], tuple[str, ...]]
) -> None:
    files, joints = drawn
    folder = tmp_path_factory.mktemp("arm")
    for name, text in files.items():
        path = folder / name.removeprefix("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        if text:
            path.write_text(text)
        else:
            write_mesh(path)
    compare(folder / "whole.xml", "tip", joints, count=4)


@st.composite
def urdfs(draw: st.DrawFn) -> tuple[str, tuple[str, ...]]:
    """A URDF with meshes, and the names of its moving joints."""
    inertial = (
        '<inertial><mass value="0.5"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    shape = "<collision><geometry>{}</geometry></collision>"
    shapes = ['<mesh filename="box.stl"/>', '<box size="0.02 0.02 0.05"/>', '<cylinder radius="0.01" length="0.05"/>']
    text, joints = f'<link name="base">{shape.format(shapes[1])}</link>', []
    for i in range(draw(st.integers(1, 5))):
        kind = draw(st.sampled_from(["revolute", "prismatic", "fixed"])) if i else "revolute"
        solid = shape.format(draw(st.sampled_from(shapes)))
        rpy = " ".join(f"{angle / 60:.3f}" for angle in draw(TURN))
        limits = "-1.5 1.5" if kind == "revolute" else "-0.1 0.2"
        lower, upper = limits.split()
        text += f'<link name="l{i}">{inertial}{solid}</link><joint name="j{i}" type="{kind}">'
        text += f'<parent link="{draw(st.sampled_from(["base", *(f"l{k}" for k in range(i))]))}"/><child link="l{i}"/>'
        text += f'<origin xyz="{draw(TRIPLE)}" rpy="{rpy}"/><axis xyz="{draw(AXIS)}"/>'
        text += f'<limit lower="{lower}" upper="{upper}" effort="40" velocity="1"/></joint>'
        joints += [f"j{i}"] if kind != "fixed" else []
    return f'<robot name="made">{text}</robot>', tuple(joints)


@settings(max_examples=12, deadline=None, phases=[Phase.explicit, Phase.generate])  # a conversion takes a second
@given(urdfs())
def test_generated_urdfs(tmp_path_factory: pytest.TempPathFactory, drawn: tuple[str, tuple[str, ...]]) -> None:
    text, joints = drawn
    folder = tmp_path_factory.mktemp("urdf")
    write_mesh(folder / "box.stl")
    path = folder / "made.urdf"
    path.write_text(text)
    check_tf(path)
    made = make_model(path, folder / "model", {})
    compare(made.mjcf, "tip", joints, count=4)
    urdf = read_urdf(path)
    model = mujoco.MjModel.from_xml_path(str(made.mjcf))
    for positions in samples({name: tuple(model.joint(name).range) for name in joints}, 4):
        poses, expected = by_tf(urdf, positions), by_mujoco(model, positions)
        base = np.linalg.inv(expected[urdf.root])  # the conversion may raise it above the table
        for link, pose in expected.items():
            np.testing.assert_allclose(poses[link], base @ pose, atol=SIX_DIGITS)
