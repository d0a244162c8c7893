"""MJCF files: what MuJoCo's compiler makes of one, and the tree of its joints.

MuJoCo reads the file, since its compiler resolves defaults, includes, frames and orientations. Kinematics, collision
checks, the page's shapes and the simulation derive what they know of the robot's geometry from it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import Robot, Vector
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf_names import read_names
from ibrobot_kinematics.model import ChainJoint, KinematicModel, TipPose
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.read_once import read_once
from ibrobot_kinematics.rotations import from_quaternion

_SLIDE, _HINGE = 2, 3
"""Values of mujoco.mjtJoint."""
_COUPLED = 2
"""Value of mujoco.mjtEq for joints."""
_LINE = re.compile(r"\bline (?:number=)?([1-9]\d*)", re.IGNORECASE)


@attrs.frozen(eq=False)
class TreeJoint:
    """A moving joint of an MJCF."""

    name: str
    parent: int
    """Index in `JointTree.joints` of the next moving joint towards the base; -1: none."""
    placement: Vector
    """Frame of the joint, whose origin is on its axis, in that of the parent at the reference, shape (4, 4)."""
    axis: Vector
    """Unit vector along the axis in the joint's own frame, shape (3,)."""
    reference: float
    """Position at which the joint causes no displacement [rad or m]."""
    slides: bool
    """Whether it is prismatic; revolute otherwise."""


@attrs.frozen
class Follower:
    """How a joint follows another one, e.g. the second finger of a gripper.

    With q and L as displacements of joint and leader from their reference positions, q = offset + factor * L.
    """

    leader: str
    factor: float
    offset: float
    """[rad or m]."""


@attrs.frozen(eq=False)
class JointTree:
    """The joints that may move, and where the bodies are in their frames."""

    joints: tuple[TreeJoint, ...]
    """From the base outwards: parents first."""
    bodies: tuple[tuple[int, Vector], ...]
    """For each of MuJoCo's bodies the joint that carries it (-1: none), and its frame in that joint's, shape (4, 4)."""


@attrs.frozen(eq=False, slots=False)
class Mjcf:
    """An MJCF. Its models are compiled when they are first needed, without their masses, and are not to be changed."""

    path: Path
    spec: Any = attrs.field(repr=False)
    """mujoco.MjSpec; copy it before changing it."""

    @cached_property
    def complete(self) -> Any:
        """mujoco.MjModel with all shapes."""
        return self._compiled(self.spec.copy())

    @cached_property
    def skeleton(self) -> Any:
        """mujoco.MjModel without shapes, which take most of the time to compile."""
        spec = self.spec.copy()
        for element in (*spec.sensors, *spec.pairs, *spec.geoms, *spec.meshes, *spec.materials, *spec.textures):
            spec.delete(element)
        return self._compiled(spec)

    @cached_property
    def solid(self) -> Any:
        """mujoco.MjModel with the shapes that can collide; bodies without any have hulls of their visible meshes."""
        spec = self.spec.copy()
        for body in _only_visible(spec):
            for geom in body.geoms:
                geom.contype = 1  # makes the compiler compute its hull
        # Meshes that are only looked at take nearly all the time to compile.
        for element in (*spec.sensors, *spec.pairs, *(geom for geom in spec.geoms if not _collides(geom))):
            spec.delete(element)
        delete_unused_meshes(spec)
        return self._compiled(spec)

    @property
    def only_visible(self) -> tuple[str, ...]:
        """Bodies with shapes of which none can collide."""
        return tuple(body.name for body in _only_visible(self.spec))

    def tree(self, model: Any, joints: Iterable[str]) -> JointTree:
        """The tree of some joints in `skeleton` or `solid`. Others, and `followers`, stay at their reference position.

        Raises:
            KinematicsError: if the file lacks a joint, or one is neither a hinge nor a slide.
        """
        known = {model.joint(i).name: i for i in range(model.njnt)}
        for name in joints:
            if name not in known:
                raise KinematicsError(f"{self.path} has no joint {name!r}; it has: {', '.join(known)}")
            if model.jnt_type[known[name]] not in (_SLIDE, _HINGE):
                raise KinematicsError(f"{self.path}: joint {name!r} is neither a hinge nor a slide")
        moving = {known[name] for name in joints}
        placed_joints: list[TreeJoint] = []
        bodies = [(-1, np.eye(4))]
        for body in range(1, model.nbody):
            carrier, placed = bodies[model.body_parentid[body]]
            placed = placed @ placement(model.body_pos[body], model.body_quat[body])
            first = int(model.body_jntadr[body])
            for joint in range(first, first + int(model.body_jntnum[body])):
                if joint not in moving:
                    continue
                anchor = homogeneous(np.eye(3), model.jnt_pos[joint])
                placed_joints.append(
                    TreeJoint(
                        model.joint(joint).name, carrier, placed @ anchor, model.jnt_axis[joint].copy(),
                        float(model.qpos0[model.jnt_qposadr[joint]]), bool(model.jnt_type[joint] == _SLIDE),
                    )
                )  # fmt: skip
                carrier, placed = len(placed_joints) - 1, np.linalg.inv(anchor)
            bodies.append((carrier, placed))
        return JointTree(tuple(placed_joints), tuple(bodies))

    def followers(self, model: Any, joints: Iterable[str]) -> Mapping[str, Follower]:
        """Other joints that follow some joints in `skeleton` or `solid`, as joints of a URDF that mimic them do.

        Joints that follow in another way, e.g. by tendons, loops, or a curve, are not among them.
        """
        coupled: dict[str, Follower] = {}
        for row in np.flatnonzero((model.eq_type == _COUPLED) & (model.eq_active0 != 0)).tolist():
            second, curve = int(model.eq_obj2id[row]), model.eq_data[row, :5]
            if second >= 0 and not curve[2:].any():
                name, leader = (model.joint(joint).name for joint in (int(model.eq_obj1id[row]), second))
                coupled[name] = Follower(leader, float(curve[1]), float(curve[0]))
        leaders = {name: Follower(name, 1.0, 0.0) for name in joints}
        followers: dict[str, Follower] = {}
        while new := {n: each for n, each in coupled.items() if each.leader in leaders and n not in leaders}:
            for name, each in new.items():
                of = leaders[each.leader]
                followers[name] = Follower(of.leader, each.factor * of.factor, each.offset + each.factor * of.offset)
            leaders |= followers
        return followers

    def chain(
        self, tip: str, joints: Sequence[str], *, lower: Vector | None = None, upper: Vector | None = None
    ) -> KinematicModel:
        """The kinematic model of a site.

        Args:
            tip: name of the site.
            joints: names of the joints that may move, in the order of vectors.
            lower: lower position limits [rad or m], shape (J,); None: those of the MJCF.
            upper: upper position limits [rad or m], shape (J,); None: those of the MJCF.

        Raises:
            KinematicsError: if the file lacks the site or a joint, if a joint is neither a hinge nor a slide or has no
                limits, or if the tip moves with a free or ball joint.
        """
        model = self.skeleton
        sites = {model.site(i).name: i for i in range(model.nsite)}
        if tip not in sites:
            raise KinematicsError(f"{self.path} has no site {tip!r}; it has: {', '.join(sites)}")
        tree = self.tree(model, joints)
        ids = [model.joint(name).id for name in joints]
        for joint in ids if lower is None or upper is None else ():
            if not model.jnt_limited[joint]:
                raise KinematicsError(f"{self.path}: joint {model.joint(joint).name!r} has no limits")
        body = int(model.site_bodyid[sites[tip]])
        carrier, placed = tree.bodies[body]
        tip_pose = placed @ placement(model.site_pos[sites[tip]], model.site_quat[sites[tip]])
        chain: list[ChainJoint] = []
        while carrier >= 0:
            each = tree.joints[carrier]
            place = each.placement
            index = joints.index(each.name)
            chain.insert(
                0, ChainJoint(index, place[:3, 3], place[:3, :3], each.axis, each.reference, each.slides)
            )  # fmt: skip
            carrier = each.parent
        self._check_carried(body)
        return KinematicModel(
            tuple(joints),
            model.jnt_range[ids, 0].copy() if lower is None else lower,
            model.jnt_range[ids, 1].copy() if upper is None else upper,
            tuple(chain),
            tip,
            TipPose(tip_pose[:3, 3], tip_pose[:3, :3]),
        )

    def _check_carried(self, body: int) -> None:
        model = self.skeleton
        while body:
            for joint in range(int(model.body_jntadr[body]), int(model.body_jntadr[body] + model.body_jntnum[body])):
                if model.jnt_type[joint] not in (_SLIDE, _HINGE):
                    name = model.joint(joint).name
                    raise KinematicsError(f"{self.path}: the tip moves with {name!r}, a free or ball joint")
            body = int(model.body_parentid[body])

    def _compiled(self, spec: Any) -> Any:
        # Only the compiler needs masses, which may come from shapes that went.
        spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6
        for joint in spec.joints:
            joint.armature = 1.0
        try:
            return spec.compile()
        except ValueError as error:
            raise unusable(self.path, error) from error


def files_of(mjcf: Mjcf) -> list[Path]:
    """The files that an MJCF consists of: itself, includes and meshes."""
    folder = Path(mjcf.spec.modelfiledir) / mjcf.spec.meshdir
    try:
        names = read_names(mjcf.path).files
    except KinematicsError:
        names = (mjcf.path,)  # e.g. a URDF
    return [*names, *(folder / mesh.file for mesh in mjcf.spec.meshes if mesh.file)]


@read_once(files_of)
def read_mjcf(path: Path) -> Mjcf:
    """Read an MJCF, or a URDF as MuJoCo understands it.

    Raises:
        KinematicsError: if MuJoCo cannot read it; names file and line where MuJoCo does.
    """
    import mujoco

    try:
        return Mjcf(path, mujoco.MjSpec.from_file(str(path)))
    except ValueError as error:
        raise unusable(path, error) from error


def unusable(path: Path, error: Exception) -> KinematicsError:
    """What is wrong with a file that MuJoCo refuses, with the line if it is known."""
    if path.suffix != ".urdf":
        try:
            read_names(path)  # names the line, and the file among those that are included
        except KinematicsError as fault:
            return fault
    text = " ".join(str(error).split())
    line = _LINE.search(text)
    return KinematicsError(f"{path}{f':{line[1]}' if line else ''}: MuJoCo cannot load it: {text}")


def several_arms(path: Path, arms: Mapping[str, Sequence[float]]) -> Any:
    """mujoco.MjSpec with a copy of an MJCF for each arm.

    Args:
        path: the MJCF of one arm.
        arms: prefix of the arm's names -> x, y, z [m] and yaw [rad] of its base.

    Raises:
        KinematicsError: as `read_mjcf`.
    """
    import mujoco

    spec = mujoco.MjSpec()
    for prefix, (x, y, z, yaw) in arms.items():
        arm = read_mjcf(path).spec.copy()
        folder = Path(arm.modelfiledir) / arm.meshdir
        for mesh in arm.meshes:
            mesh.name, mesh.file = mesh_name(mesh), str(folder / mesh.file) if mesh.file else ""  # or by its vertices
        arm.meshdir = ""
        for option in ("integrator", "iterations", "ls_iterations", "timestep", "cone", "impratio"):
            setattr(spec.option, option, getattr(arm.option, option))
        base = spec.worldbody.add_frame(pos=[x, y, z], quat=[math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])
        spec.attach(arm, prefix=prefix, frame=base)
    return spec


def mesh_name(mesh: Any) -> str:
    """The name by which geoms of a mujoco.MjSpec refer to a mesh."""
    return mesh.name or Path(mesh.file).stem


def delete_unused_meshes(spec: Any) -> None:
    """Delete the meshes of a mujoco.MjSpec that no geom has."""
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh_name(mesh) not in used:
            spec.delete(mesh)


def _only_visible(spec: Any) -> list[Any]:
    return [body for body in spec.bodies if body.geoms and not any(map(_collides, body.geoms))]


def _collides(geom: Any) -> bool:
    return bool(geom.contype or geom.conaffinity)


def robot_model(robot: Robot, joints: Sequence[str] | None = None) -> KinematicModel:
    """The kinematic model of a robot's tip, within the robot's joint limits.

    Args:
        robot: its description has the MJCF and the tip, a site in it.
        joints: the joints that may move, in the order of vectors; None: all of the robot's. Others stay at zero. If
            the robot has several arms, the joints of one of them; the base frame is then that of the arm.

    Raises:
        KinematicsError: if the description has no MJCF, the MJCF cannot be read or lacks the tip or a joint, or the
            joints belong to several arms.
        KeyError: for a name in `joints` that is not a joint of the robot.
    """
    description = robot.description
    if description.mjcf is None:
        raise KinematicsError(f"robot {robot.name!r} has no robot.description.mjcf; kinematics needs a MuJoCo model")
    names = robot.joint_names if joints is None else tuple(joints)
    order = robot.indices(names)
    lower, upper = robot.lower[order], robot.upper[order]
    arms = list(dict.fromkeys(map(description.arm_of, names)))
    if len(arms) > 1:
        known = ", ".join(map(repr, arms))
        raise KinematicsError(f"robot {robot.name!r} has several arms ({known}), each with a tool: choose one of them")
    own = [name.removeprefix(arm) for arm in arms for name in names]
    try:
        model = read_mjcf(description.mjcf).chain(description.tip, own, lower=lower, upper=upper)
    except KinematicsError as error:
        raise KinematicsError(f"robot.description: {error}") from error
    return attrs.evolve(model, joint_names=names)


def placement(position: Sequence[float] | Vector, quaternion: Sequence[float] | Vector) -> Vector:
    """The matrix, shape (4, 4), of MuJoCo's position and quaternion (w, x, y, z)."""
    return homogeneous(from_quaternion(np.roll(quaternion, -1)), np.asarray(position, dtype=float))
