"""Convert a URDF to an MJCF for simulation and planning. Values that a URDF lacks are guessed, and reported."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import attrs
import mujoco
import numpy as np
from ibrobot_kinematics.urdf import UrdfJoint
from numpy.typing import NDArray

from ibrobot_core.api import HardwareError, did_you_mean
from ibrobot_mujoco.chains import Chain, chains_of, parents_of
from ibrobot_mujoco.meshes import Meshes
from ibrobot_mujoco.plausibility import Drive, check_plausible, loads, summary
from ibrobot_mujoco.ros_packages import Packages
from ibrobot_mujoco.urdf_file import STILL, Inertial, Link, Robot, Shape, read_robot, several

type Pose = NDArray[np.float64]

_FREQUENCY_HZ = 8.0
"""Natural frequency of a guessed position servo with the inertia that it moves: stable at steps of 2 ms, and stiff."""
_ARMATURE = 1e-3
"""Guessed inertia of a drive, for each N m (or N) of its effort [kg m^2, kg]."""
_LEAST_ARMATURE = 5e-3
EFFORT, VELOCITY = 20.0, 1.0
"""Effort and velocity of joints without them in the URDF [N m or N; rad/s or m/s]."""
_STRENGTH = 2.0
"""A guessed effort holds at least this multiple of the weight."""
TURN_RAD = 2 * math.pi
_SHORT_M = 0.15
"""A sliding joint with a longer way is not a gripper's."""
_DENSITY = 1000.0
"""Guessed density of shapes whose link has no mass [kg/m^3]."""
_LEAST_KG, _LEAST_KGM2 = 1e-9, 1e-12
"""MuJoCo refuses smaller masses and inertias."""
_EMPTY_KG, _EMPTY_KGM2 = 0.01, 1e-5
"""Guessed mass and inertia of a link that moves, and has neither mass nor shape."""
_BALL_M = 0.05
"""Radius of the ball whose inertia is guessed where that of the URDF is impossible."""
_DRAWS = 300
_TABLE_M = 0.005
"""How far the table is below the base."""
_OFTEN = 0.95
"""Two bodies that touch in a larger fraction of random poses always touch: their meshes overlap."""
FINGER = re.compile(r"finger|gripper|knuckle|jaw|claw", re.IGNORECASE)
_FINGER_LINK = re.compile(r"finger|knuckle|jaw|claw", re.IGNORECASE)
TIP = re.compile(r"tcp|tool|tip|grasp|ee_|_ee|hand", re.IGNORECASE)
_GEOMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}


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
    chains: tuple[Chain, ...]
    home: tuple[float, ...]
    """A pose without contacts [rad or m], in the order of the joints."""
    notes: tuple[str, ...]
    """The guesses, one sentence each."""
    doubts: tuple[str, ...]
    """What hardly fits together, one sentence each."""
    tip: str = "tip"
    """The site of the tool."""


def make_model(
    urdf: Path, folder: Path, packages: Mapping[str, Path], tip: str | None = None,
    arguments: Mapping[str, str] | None = None,
) -> RobotModel:  # fmt: skip
    """Write `folder/model.xml` and the meshes that it needs.

    Args:
        urdf: a URDF or xacro file.
        folder: a new folder.
        packages: ROS package -> folder, for `package://` and `$(find …)` in the file; others are looked for above and
            beside it.
        tip: link whose frame is that of the tool; by default the last one named like a tool, or the last of the arm.
        arguments: values of a xacro file's arguments.

    Raises:
        HardwareError: if the file cannot be read or lacks a mesh, or describes no arm, or an absurd one.
    """
    places = Packages(urdf, packages)
    robot = read_robot(urdf, places, arguments or {})
    notes = list(robot.notes)
    name = re.sub(r"\W+", "_", robot.name or urdf.stem)
    folder.mkdir(parents=True)
    try:
        spec = _bodies(robot, Meshes(folder, places), notes)
        joints, doubts = _drive(spec, robot, notes)
        model = _compiled(spec, urdf)
        notes.append(summary(model))
        chains = chains_of(parents_of(model, [each.name for each in joints]), grips_of(joints))
        _set_tip(spec, robot, joints, chains[0], tip, notes)
        home = settle(spec, joints, notes, doubts)
        mjcf = write_model(spec, folder)
    except BaseException:
        shutil.rmtree(folder)
        raise
    return RobotModel(mjcf, name, joints, chains, home, tuple(notes), tuple(doubts))


def write_model(spec: mujoco.MjSpec, folder: Path) -> Path:
    """Write `model.xml`, and check that MuJoCo reads it."""
    path = folder / "model.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    try:
        mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise HardwareError(f"MuJoCo cannot load the model: {' '.join(str(error).split())}") from error
    return path


def _compiled(spec: mujoco.MjSpec, urdf: Path) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        text = " ".join(str(error).removeprefix("Error: ").split())
        raise HardwareError(f"{urdf}: MuJoCo cannot load it: {text}") from error


def _bodies(robot: Robot, meshes: Meshes, notes: list[str]) -> mujoco.MjSpec:
    """The links as bodies, with their joints, shapes and masses."""
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    spec.meshdir, spec.modelfiledir = ".", str(meshes.folder.absolute())
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    root = robot.links[robot.root]
    bodies = {root.name: spec.worldbody if root.name == "world" else spec.worldbody.add_body(name=root.name)}
    for child, joint in robot.joints.items():
        body = bodies[joint.parent].add_body(name=child, pos=joint.xyz, quat=_quaternion(joint.rpy), gravcomp=1)
        bodies[child] = body
        if joint.type not in STILL:
            slides = joint.type == "prismatic"
            body.add_joint(
                name=joint.name,
                type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE,
                axis=joint.axis,
                limited=True,
                range=joint.limits or (-TURN_RAD, TURN_RAD),
            )
    solid = {name: _shapes(spec, bodies[name], link, meshes) for name, link in robot.links.items()}
    _masses(robot, bodies, solid, notes)
    notes += meshes.notes()
    return spec


def _quaternion(rpy: Sequence[float]) -> Pose:
    """Roll, pitch and yaw about fixed axes as a quaternion wxyz, shape (4,)."""
    quaternion = np.zeros(4)
    mujoco.mju_euler2Quat(quaternion, np.array(rpy), "XYZ")
    return quaternion


def _shapes(spec: mujoco.MjSpec, body: mujoco.MjsBody, link: Link, meshes: Meshes) -> bool:
    """Add the shapes of a link; returns whether it has any."""
    solid = False
    for shape in link.shapes:
        place = {"pos": shape.xyz, "quat": _quaternion(shape.rpy), "density": _DENSITY}
        if shape.kind == "mesh":
            mesh = meshes.take(spec, shape, link.name)
            if mesh is not None:
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, **place)
                solid = True
            continue
        body.add_geom(type=_GEOMS[shape.kind], size=_sizes(shape), **place)
        solid = True
    return solid


def _sizes(shape: Shape) -> list[float]:
    match shape.kind:
        case "box":
            return [each / 2 for each in shape.size]
        case "sphere":
            return [shape.size[0], 0, 0]
        case _:
            return [shape.size[0], shape.size[1] / 2, 0]


def _masses(robot: Robot, bodies: Mapping[str, mujoco.MjsBody], solid: Mapping[str, bool], notes: list[str]) -> None:
    """Set masses and inertias, and guess those that the URDF lacks."""
    invented: list[str] = []
    impossible: list[str] = []
    empty: list[str] = []
    heavy = {name for name, link in robot.links.items() if _weighs(link) or solid[name]}
    moving = {child for child, joint in robot.joints.items() if joint.type not in STILL}
    for name, link in robot.links.items():
        body = bodies[name]
        if name == "world":
            continue
        if link.inertial is None or not _weighs(link):
            if solid[name] and _moves(name, robot, moving):
                invented.append(name)
            elif name in moving and not heavy & _rigid(name, robot, moving):
                _weigh(body, _EMPTY_KG, (0.0, 0.0, 0.0))
                body.inertia = [_EMPTY_KGM2] * 3
                empty.append(name)
            continue
        if not _set_inertia(body, link.inertial):
            impossible.append(name)
    for text, names in (
        (f"Without mass in the URDF, that of the shapes at {_DENSITY:g} kg/m^3: {{}}.", invented),
        ("With an impossible inertia in the URDF, or none, that of a ball of "
         f"{_BALL_M * 100:g} cm with the link's mass: {{}}.", impossible),
        (f"Without mass and shape in the URDF, {_EMPTY_KG:g} kg: {{}}.", empty),
    ):  # fmt: skip
        if names:
            notes.append(text.format(several(names)))


def _weighs(link: Link) -> bool:
    return link.inertial is not None and link.inertial.mass > _LEAST_KG


def _moves(name: str, robot: Robot, moving: set[str]) -> bool:
    """Whether some joint moves a link."""
    while name in robot.joints:
        if name in moving:
            return True
        name = robot.joints[name].parent
    return False


def _rigid(name: str, robot: Robot, moving: set[str]) -> set[str]:
    """The links that are one solid with a link and those below it."""
    rigid = {name}
    for child, joint in robot.joints.items():  # parents come first
        if joint.parent in rigid and child not in moving:
            rigid.add(child)
    return rigid


def _weigh(body: mujoco.MjsBody, mass: float, centre: Sequence[float]) -> None:
    """Set the mass; the inertia comes after it."""
    body.mass, body.ipos, body.iquat, body.explicitinertial = mass, centre, [1, 0, 0, 0], True


def _set_inertia(body: mujoco.MjsBody, inertial: Inertial) -> bool:
    """Set mass and inertia; returns whether the URDF's is that of a solid."""
    _weigh(body, inertial.mass, inertial.xyz)
    ball = 0.4 * inertial.mass * _BALL_M**2
    if inertial.inertia:
        xx, yy, zz, xy, xz, yz = inertial.inertia
        values, vectors = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        # A little more than the sum is rounding in the file.
        if values[0] > _LEAST_KGM2 and values[2] <= (values[0] + values[1]) * 1.02:
            vectors[:, 2] *= np.sign(np.linalg.det(vectors))
            turned, inner = np.zeros(4), np.zeros(4)
            mujoco.mju_mat2Quat(inner, vectors.ravel())
            mujoco.mju_mulQuat(turned, _quaternion(inertial.rpy), inner)
            values[2] = min(values[2], values[0] + values[1])
            body.inertia, body.iquat = values, turned
            return True
    body.inertia = [max(ball, 2 * _LEAST_KGM2)] * 3
    return False


def grips_of(joints: Sequence[DrivenJoint]) -> list[str]:
    """The names of the joints of grippers."""
    return [each.name for each in joints if each.gripper]


def mark_grippers(joints: Sequence[DrivenJoint], model: mujoco.MjModel) -> list[DrivenJoint]:
    """The joints, each with whether it opens a gripper: by its name, or at the end of an arm by its body or short way.

    If all do, as in a hand, none does.
    """
    parents = parents_of(model, [each.name for each in joints])
    carries = {parents[each.name] for each in joints if not FINGER.search(each.name)}

    def grips(joint: DrivenJoint) -> bool:
        if FINGER.search(joint.name):
            return True
        slides = model.joint(joint.name).type[0] == mujoco.mjtJoint.mjJNT_SLIDE
        body = model.body(model.joint(joint.name).bodyid[0]).name
        return joint.name not in carries and bool(
            _FINGER_LINK.search(body) or (slides and joint.upper - joint.lower <= _SHORT_M)
        )

    marked = [attrs.evolve(each, gripper=grips(each)) for each in joints]
    return [attrs.evolve(each, gripper=False) for each in marked] if all(each.gripper for each in marked) else marked


def _drive(spec: mujoco.MjSpec, robot: Robot, notes: list[str]) -> tuple[tuple[DrivenJoint, ...], list[str]]:
    """Give each joint a drive, and those that mimic another one a coupling; returns the joints, and doubts."""
    notes.append("The drives hold the weight of the arm by themselves (gravcomp), as controllers of such arms do.")
    elements = {each.name: each for each in robot.joints.values()}
    driven: list[DrivenJoint] = []
    for joint in spec.joints:
        element = elements[joint.name]
        joint.armature = max(_LEAST_ARMATURE, _ARMATURE * (element.effort or EFFORT))
        if element.mimic is not None:
            coupling = spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=joint.name,
                name2=element.mimic.joint,
            )
            coupling.data = [element.mimic.offset, element.mimic.multiplier, *[0.0] * (len(coupling.data) - 2)]
            joint.limited = False  # its leader has limits
            continue
        lower, upper = map(float, joint.range)
        velocity = element.velocity or VELOCITY
        # From full speed, a joint brakes to a stand within 75 ms, so that every stop takes less than 100 ms.
        driven.append(DrivenJoint(joint.name, lower, upper, velocity, velocity / 0.075, False))
    if not driven:
        raise HardwareError(f"{robot.file}: the URDF has no joint that moves an arm")
    model = _compiled(spec, robot.file)
    joints = mark_grippers(driven, model)
    ranges = {each.name: (each.lower, each.upper) for each in joints}
    weights, inertias = loads(model, ranges)
    efforts = {
        each.name: elements[each.name].effort
        or max(EFFORT, math.ceil(_STRENGTH * weights[model.joint(each.name).dofadr[0]]))
        for each in joints
    }
    places = {name: link.place for name, link in robot.links.items()}
    drives = [Drive(each.name, efforts[each.name], each.max_velocity, each.lower, each.upper) for each in joints]
    doubts = check_plausible(model, drives, (weights, inertias), places)
    add_servos(spec, model, joints, efforts, inertias)
    _note_drives(joints, elements, efforts, notes)
    return tuple(joints), doubts


def _note_drives(
    joints: Sequence[DrivenJoint], elements: Mapping[str, UrdfJoint], efforts: Mapping[str, float], notes: list[str]
) -> None:
    notes.append(f"Each drive is a position servo of {_FREQUENCY_HZ:g} Hz, critically damped, with the URDF's effort.")
    notes.append("max_acceleration is such that each joint brakes from its full speed within 75 ms.")
    plain = [each.name for each in joints if not elements[each.name].effort and efforts[each.name] == EFFORT]
    strong = [
        f"{each.name} ({efforts[each.name]:g})"
        for each in joints
        if not elements[each.name].effort and efforts[each.name] != EFFORT
    ]
    for text, names in (
        (f"The URDF states no effort for {{}}: {EFFORT:g} N m (or N).", plain),
        ("The URDF states no effort for {}: twice what holds the weight [N m or N].", strong),
        (f"The URDF states no speed for {{}}: {VELOCITY:g} rad/s (or m/s).",
         [each.name for each in joints if not elements[each.name].velocity]),
        ("Without end in the URDF, here one turn to each side: {}.",
         [each.name for each in joints if elements[each.name].limits is None]),
        ("Moved by another joint, as the URDF says: {}.",
         [each.name for each in elements.values() if each.mimic is not None]),
        ("The gripper, by names and short ways: {}.", grips_of(joints)),
    ):  # fmt: skip
        if names:
            notes.append(text.format(several(names)))


def add_servos(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Sequence[DrivenJoint], efforts: Mapping[str, float],
    inertias: Pose,
) -> None:  # fmt: skip
    """Position servos whose gains fit the largest inertia that each moves in some poses.

    Args:
        spec: the model to change.
        model: the compiled model.
        joints: the joints that get a servo.
        efforts: joint -> largest torque or force [N m or N].
        inertias: of each degree of freedom, from `loads`; shape (nv,).
    """
    omega = 2 * math.pi * _FREQUENCY_HZ
    for joint in joints:
        inertia = inertias[model.joint(joint.name).dofadr[0]]
        effort = efforts[joint.name]
        spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gainprm=[inertia * omega**2, *[0] * 9], biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, -inertia * omega**2, -2 * inertia * omega, *[0] * 7],
            forcelimited=True, forcerange=[-effort, effort], ctrllimited=True, ctrlrange=[joint.lower, joint.upper],
        )  # fmt: skip


def _set_tip(
    spec: mujoco.MjSpec, robot: Robot, joints: tuple[DrivenJoint, ...], chain: Chain, tip: str | None, notes: list[str]
) -> None:
    """Add the site `tip`."""
    if tip is None:
        grips = set(grips_of(joints))
        arm = [link for link in robot.links if _comes_after(link, chain.joints[-1], robot.joints, grips)]
        tip = next((link for link in reversed(arm) if TIP.search(link)), arm[-1])
        of = "" if chain.name == "arm" else f" of {chain.name}"
        notes.append(f"The tool{of} is the frame of the link {tip}; --tip LINK sets another one.")
    elif tip not in robot.links:
        links = list(robot.links)
        raise HardwareError(f"the URDF has no link {tip!r}{did_you_mean(tip, links, 'it has')}")
    (spec.worldbody if tip == "world" else spec.body(tip)).add_site(name="tip")


def _comes_after(link: str, joint: str, joints: Mapping[str, UrdfJoint], grips: set[str]) -> bool:
    """Whether a link is moved by a joint, but by no finger."""
    while (element := joints.get(link)) is not None:
        if element.name == joint:
            return True
        if element.name in grips or element.mimic is not None:
            return False
        link = element.parent
    return False


def settle(
    spec: mujoco.MjSpec, joints: tuple[DrivenJoint, ...], notes: list[str], doubts: list[str]
) -> tuple[float, ...]:
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
    _exclude(spec, model, always)
    if always:
        notes.append(f"Pairs of bodies whose shapes always overlap are no contacts (<exclude>): {len(always)}.")
    middle = (lower + upper) / 2
    inside = np.where((zero - lower < 0.1) | (upper - zero < 0.1), middle, zero)
    poses = [
        zero,
        *_bent(zero, lower, upper),
        inside,
        middle,
        *generator.uniform(lower, upper, (_DRAWS, len(joints))),
    ]
    on_table = spec.copy()
    on_table.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], pos=[0, 0, -_TABLE_M])
    home = _without_contacts(on_table.compile(), joints, poses)
    if home is not None:
        notes.append("The pose home has no contacts, also not with a table at the height of the base.")
        return _written(home, lower, upper)
    model = spec.compile()
    home = _without_contacts(model, joints, poses)
    if home is None:
        data = mujoco.MjData(model)
        home = min(poses, key=lambda pose: len(_touching(model, data, joints, pose)))
        pairs = list(_touching(model, data, joints, home))
        _exclude(spec, model, pairs)
        names = [" and ".join(model.body(each).name for each in sorted(pair)) for pair in pairs]
        doubts.append(
            "Some bodies touch in every pose that was tried, so these pairs are no contacts (<exclude>): "
            f"{several(names)}"
        )
        home_text = "The pose home is the one with the fewest contacts"
    else:
        home_text = "The pose home has no contacts"
    data = mujoco.MjData(model)
    _touching(model, data, joints, home)
    if (height := math.ceil(max(0.0, -_lowest(model, data)) * 100) / 100) > 0:
        for body in spec.worldbody.bodies:
            body.pos = [*body.pos[:2], body.pos[2] + height]
        notes.append(f"The base stands {height:g} m above the table, since parts of the robot are below its base.")
    notes.append(f"{home_text}.")
    return _written(home, lower, upper)


def _written(pose: Pose, lower: Pose, upper: Pose) -> tuple[float, ...]:
    """A pose with few digits, within the limits."""
    return tuple(float(each) for each in np.clip(np.round(pose, 4), lower, upper))


def _exclude(spec: mujoco.MjSpec, model: mujoco.MjModel, pairs: Iterable[frozenset[int]]) -> None:
    for pair in pairs:
        first, second = (model.body(each).name for each in sorted(pair))
        spec.add_exclude(bodyname1=first, bodyname2=second)


def _without_contacts(model: mujoco.MjModel, joints: tuple[DrivenJoint, ...], poses: Sequence[Pose]) -> Pose | None:
    data = mujoco.MjData(model)
    return next((pose for pose in poses if not _touching(model, data, joints, pose)), None)


def _lowest(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Height of the lowest corner of a box around a shape that moves [m]."""
    heights = [0.0]
    for geom in range(model.ngeom):
        if model.body_weldid[model.geom_bodyid[geom]]:
            up = data.geom_xmat[geom].reshape(3, 3)[2]
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            heights.append(float(data.geom_xpos[geom, 2] + up @ centre - np.abs(up) @ half))
    return min(heights)


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
