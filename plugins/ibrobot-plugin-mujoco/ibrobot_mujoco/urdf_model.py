"""Convert a URDF to an MJCF for simulation and planning. Values that a URDF lacks are guessed, and reported."""

from __future__ import annotations

import math
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ElementTree, ParseError, SubElement, fromstring

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import HardwareError

type Pose = NDArray[np.float64]

_READS = (".stl", ".obj", ".msh")
"""Meshes that MuJoCo reads."""
_FREQUENCY_HZ = 8.0
"""Natural frequency of a guessed position servo with the inertia that it moves: stable at steps of 2 ms, and stiff."""
_ARMATURE = 1e-3
"""Guessed inertia of a drive, for each N m (or N) of its effort [kg m^2, kg]."""
_LEAST_ARMATURE = 5e-3
EFFORT, VELOCITY = 20.0, 1.0
"""Effort and velocity of joints without them in the URDF [N m or N; rad/s or m/s]."""
TURN_RAD = 2 * math.pi
_DRAWS = 300
_OFTEN = 0.95
"""Two bodies that touch in a larger fraction of random poses always touch: their meshes overlap."""
FINGER = re.compile(r"finger|gripper|knuckle|jaw|claw", re.IGNORECASE)
TIP = re.compile(r"tcp|tool|tip|grasp|ee_|_ee|hand", re.IGNORECASE)


@attrs.frozen
class DrivenJoint:
    """A joint with a drive: the limits are in rad, rad/s and rad/s^2, or in m."""

    name: str
    lower: float
    upper: float
    max_velocity: float
    max_acceleration: float
    gripper: bool
    """Whether it opens a gripper."""


@attrs.frozen
class RobotModel:
    """A model made from a URDF or an MJCF."""

    mjcf: Path
    name: str
    joints: tuple[DrivenJoint, ...]
    home: tuple[float, ...]
    """A pose without contacts [rad or m], in the order of the joints."""
    notes: tuple[str, ...]
    """The guesses, one sentence each."""
    tip: str = "tip"
    """The site of the tool."""


def make_model(urdf: Path, folder: Path, packages: Mapping[str, Path], tip: str | None = None) -> RobotModel:
    """Write `folder/model.xml` and the meshes that it needs.

    Args:
        urdf: a URDF or xacro file.
        folder: a new folder.
        packages: ROS package -> folder, for `package://` in the file; others are looked for in the folders above it.
        tip: link whose frame is that of the tool; by default the last one named like a tool, or the last of the arm.

    Raises:
        HardwareError: if the file cannot be read or lacks a mesh, or describes no arm.
    """
    notes: list[str] = []
    root = _parse(urdf)
    name = re.sub(r"\W+", "_", root.get("name", urdf.stem))
    folder.mkdir(parents=True)
    try:
        _take_meshes(root, urdf, folder, packages, notes)
        links = _links_with_joints(root)
        spec = _load(root, folder)
        joints = _drive(spec, root, notes)
        _set_tip(spec, root, links, joints, tip, notes)
        home = settle(spec, joints, notes)
        mjcf = folder / "model.xml"
        mjcf.write_text(spec.to_xml(), encoding="utf-8")
    except BaseException:
        shutil.rmtree(folder)
        raise
    return RobotModel(mjcf, name, joints, home, tuple(notes))


def _parse(urdf: Path) -> Element:
    try:
        text = urdf.read_text(encoding="utf-8")
        if "xmlns:xacro" in text:
            try:
                import xacro
            except ImportError:
                raise HardwareError(f"{urdf} is a xacro file: pip install 'ibrobot-plugin-mujoco[urdf]'") from None
            text = xacro.process_file(str(urdf)).toxml()
        root = fromstring(text)
    except (OSError, ParseError, UnicodeDecodeError) as error:
        raise HardwareError(f"{urdf} cannot be read: {error}") from None
    if root.tag != "robot":
        raise HardwareError(f"{urdf} is not a URDF: its first element is <{root.tag}>, must be <robot>")
    return root


def _find_mesh(name: str, urdf: Path, packages: Mapping[str, Path]) -> Path:
    if not name.startswith("package://"):
        path = Path(unquote(name.removeprefix("file://")))
        return path if path.is_absolute() else urdf.parent / path
    package, _, inside = unquote(name.removeprefix("package://")).partition("/")
    if package in packages:
        return packages[package] / inside
    above = next((each for each in urdf.resolve().parents if each.name == package), None)
    if above is None:
        raise HardwareError(f"{urdf}: no folder above it is the package {package!r}: give --package {package}=FOLDER")
    return above / inside


def _take_meshes(root: Element, urdf: Path, folder: Path, packages: Mapping[str, Path], notes: list[str]) -> None:
    """Copy the collision meshes, converted where MuJoCo cannot read them; drop visual ones."""
    converted = False
    for link in root.iter("link"):
        solids = link.findall("collision")
        for each in link.findall("visual") if solids else ():
            link.remove(each)
        for each in link.findall("visual"):
            each.tag = "collision"
        for mesh in link.iter("mesh"):
            source = _find_mesh(mesh.get("filename", ""), urdf, packages)
            if not source.is_file():
                raise HardwareError(f"{urdf}: link {link.get('name')!r} has the mesh {source}, which does not exist")
            relative = f"{len(list(folder.iterdir())):02d}_{source.stem}"
            if source.suffix.lower() in _READS:
                target = folder / f"{relative}{source.suffix.lower()}"
                shutil.copyfile(source, target)
            else:
                target, converted = folder / f"{relative}.stl", True
                _convert(source, target)
            mesh.set("filename", target.name)
    if converted:
        notes.append("Meshes that MuJoCo does not read are converted to STL.")
    notes.append("The shapes are the convex hulls of the URDF's collision meshes.")


def _convert(source: Path, target: Path) -> None:
    try:
        import trimesh
    except ImportError:
        raise HardwareError(f"{source} must be converted to STL: pip install 'ibrobot-plugin-mujoco[urdf]'") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of NumPy, for the reader of .dae
            mesh: Any = trimesh.load(str(source), force="mesh")
            mesh.export(str(target))
    except Exception as error:  # trimesh raises the errors of many readers
        raise HardwareError(f"{source} cannot be converted to STL: {error}") from error


def _links_with_joints(root: Element) -> dict[str, Element]:
    """Child link -> its joint."""
    joints = ((joint.find("child"), joint) for joint in root.findall("joint"))
    return {child.get("link", ""): joint for child, joint in joints if child is not None}


def _load(root: Element, folder: Path) -> mujoco.MjSpec:
    extension = SubElement(root, "mujoco")
    # Fixed links stay, so that their frames can be the tool's.
    SubElement(extension, "compiler", fusestatic="false", strippath="false", meshdir=".", balanceinertia="true")
    path = folder / "model.urdf"
    ElementTree(root).write(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        spec.compile()
    except ValueError as error:
        raise HardwareError(f"MuJoCo cannot load the URDF: {error}") from error
    path.unlink()
    spec.meshdir = "."
    return spec


def _drive(spec: mujoco.MjSpec, root: Element, notes: list[str]) -> tuple[DrivenJoint, ...]:
    """Give each joint a drive, and those that mimic another one a coupling."""
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    elements = {each.get("name"): each for each in root.findall("joint")}
    for body in spec.bodies[1:]:
        body.gravcomp = 1
    notes.append("The drives hold the weight of the arm by themselves (gravcomp), as controllers of such arms do.")
    joints: list[DrivenJoint] = []
    unknown: list[str] = []
    turning: list[str] = []
    followers: list[str] = []
    efforts: dict[str, float] = {}
    for joint in spec.joints:
        element = elements[joint.name]
        mimic, limit = element.find("mimic"), element.find("limit")
        effort = float(limit.get("effort", 0)) if limit is not None else 0.0
        velocity = float(limit.get("velocity", 0)) if limit is not None else 0.0
        if not effort or not velocity:
            unknown.append(joint.name)
        effort, velocity = effort or EFFORT, velocity or VELOCITY
        armature = max(_LEAST_ARMATURE, _ARMATURE * effort)
        joint.armature = armature
        if mimic is not None:
            leader = mimic.get("joint", "")
            coupling = spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=joint.name, name2=leader
            )
            polynomial = [float(mimic.get("offset", 0)), float(mimic.get("multiplier", 1))]
            coupling.data = [*polynomial, *[0.0] * (len(coupling.data) - 2)]
            followers.append(joint.name)
            continue
        if element.get("type") == "continuous":
            joint.limited, joint.range = True, [-TURN_RAD, TURN_RAD]
            turning.append(joint.name)
        efforts[joint.name] = effort
        lower, upper = map(float, joint.range)
        gripper = bool(FINGER.search(joint.name)) or joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        # From full speed, a joint brakes to a stand within 75 ms, so that every stop takes less than 100 ms.
        joints.append(DrivenJoint(joint.name, lower, upper, velocity, round(velocity / 0.075, 1), gripper))
    if not any(not each.gripper for each in joints):
        raise HardwareError("the URDF has no joint that moves an arm")
    add_servos(spec, joints, efforts)
    notes.append(f"Each drive is a position servo of {_FREQUENCY_HZ:g} Hz, critically damped, with the URDF's effort.")
    notes.append("max_acceleration is such that each joint brakes from its full speed within 75 ms.")
    if unknown:
        notes.append(
            f"The URDF states no effort or no speed for {', '.join(unknown)}: {EFFORT:g} N m and {VELOCITY:g} rad/s."
        )
    if turning:
        notes.append(f"Without end in the URDF, here one turn to each side: {', '.join(turning)}.")
    if followers:
        notes.append(f"Moved by another joint, as the URDF says: {', '.join(followers)}.")
    return tuple(joints)


def add_servos(spec: mujoco.MjSpec, joints: list[DrivenJoint], efforts: Mapping[str, float]) -> None:
    """Position servos whose gains fit the largest inertia that each moves in some poses."""
    model = spec.compile()
    data = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    most = np.zeros(model.nv)
    for _ in range(50):
        for joint in joints:
            data.joint(joint.name).qpos = generator.uniform(joint.lower, joint.upper)
        mujoco.mj_forward(model, data)
        for i, unit in enumerate(np.eye(model.nv)):
            moved = np.zeros(model.nv)
            mujoco.mj_mulM(model, data, moved, unit)
            most[i] = max(most[i], moved[i])
    omega = 2 * math.pi * _FREQUENCY_HZ
    for joint in joints:
        inertia = most[model.joint(joint.name).dofadr[0]]
        effort = efforts[joint.name]
        spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gainprm=[inertia * omega**2, *[0] * 9], biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, -inertia * omega**2, -2 * inertia * omega, *[0] * 7],
            forcelimited=True, forcerange=[-effort, effort], ctrllimited=True, ctrlrange=[joint.lower, joint.upper],
        )  # fmt: skip


def _set_tip(
    spec: mujoco.MjSpec, root: Element, links: Mapping[str, Element], joints: tuple[DrivenJoint, ...],
    tip: str | None, notes: list[str],
) -> None:  # fmt: skip
    """Add the site `tip`."""
    names = [each.get("name", "") for each in root.iter("link")]
    if tip is None:
        grips = {each.name for each in joints if each.gripper}
        last = [each.name for each in joints if not each.gripper][-1]
        arm = [link for link in names if _comes_after(link, last, links, grips)]
        tip = next((link for link in reversed(arm) if TIP.search(link)), arm[-1])
        notes.append(f"The tool is the frame of the link {tip}; --tip LINK sets another one.")
    elif tip not in names:
        raise HardwareError(f"the URDF has no link {tip!r}; it has: {', '.join(names)}")
    spec.body(tip).add_site(name="tip")


def _comes_after(link: str, joint: str, links: Mapping[str, Element], grips: set[str]) -> bool:
    """Whether a link is moved by a joint, but by no finger."""
    while (element := links.get(link)) is not None:
        if element.get("name") == joint:
            return True
        if element.get("name") in grips or element.find("mimic") is not None:
            return False
        parent = element.find("parent")
        link = parent.get("link", "") if parent is not None else ""
    return False


def settle(spec: mujoco.MjSpec, joints: tuple[DrivenJoint, ...], notes: list[str]) -> tuple[float, ...]:
    """Exclude contacts of bodies that always touch; returns a pose without contacts."""
    model = spec.compile()
    data = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    zero = np.array([min(max(0.0, each.lower), each.upper) for each in joints])
    lower, upper = (np.array([getattr(each, side) for each in joints]) for side in ("lower", "upper"))
    often: dict[frozenset[int], int] = {}
    for _ in range(_DRAWS):
        for pair in _touching(model, data, joints, generator.uniform(lower, upper)):
            often[pair] = often.get(pair, 0) + 1
    always = [pair for pair, count in often.items() if count >= _OFTEN * _DRAWS]
    for pair in always:
        first, second = (model.body(each).name for each in sorted(pair))
        spec.add_exclude(name=f"{first}__{second}", bodyname1=first, bodyname2=second)
    if always:
        notes.append(f"{len(always)} pairs of bodies whose shapes always overlap are no contacts (<exclude>).")
    on_table = spec.copy()
    on_table.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], pos=[0, 0, -0.005])
    model = on_table.compile()
    data = mujoco.MjData(model)
    middle = (lower + upper) / 2
    inside = np.where((zero - lower < 0.1) | (upper - zero < 0.1), middle, zero)
    for pose in (
        zero,
        *_bent(zero, lower, upper),
        inside,
        middle,
        *generator.uniform(lower, upper, (_DRAWS, len(joints))),
    ):
        if not _touching(model, data, joints, pose):
            notes.append("The pose home has no contacts, also not with a table at the height of the base.")
            return tuple(round(float(each), 4) for each in pose)
    raise HardwareError("the arm touches itself in every pose that was tried: its collision shapes overlap")


def _bent(zero: Pose, lower: Pose, upper: Pose) -> Iterator[Pose]:
    """The pose `zero` with one joint at a right angle, and with two."""
    angles = [
        (i, angle) for i in range(len(zero)) for angle in (-math.pi / 2, math.pi / 2) if lower[i] < angle < upper[i]
    ]
    for count in (1, 2):
        for some in combinations(angles, count):
            pose = zero.copy()
            for i, angle in some:
                pose[i] = angle
            yield pose


def _touching(
    model: mujoco.MjModel, data: mujoco.MjData, joints: tuple[DrivenJoint, ...], pose: Pose
) -> set[frozenset[int]]:
    """Pairs of bodies that touch in a pose."""
    mujoco.mj_resetData(model, data)
    for joint, value in zip(joints, pose, strict=True):
        data.joint(joint.name).qpos = value
    for i in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        follower, leader = model.jnt_qposadr[model.eq_obj1id[i]], model.jnt_qposadr[model.eq_obj2id[i]]
        data.qpos[follower] = model.eq_data[i, 0] + model.eq_data[i, 1] * data.qpos[leader]
    mujoco.mj_fwdPosition(model, data)
    geoms = data.contact.geom[: data.ncon]
    return {frozenset(map(int, model.geom_bodyid[pair])) for pair in geoms if data.ncon}
