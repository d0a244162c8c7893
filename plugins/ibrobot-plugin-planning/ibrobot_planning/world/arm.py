"""The collision model of the arm: joints and the shapes of its links, from the MJCF.

Pinocchio places the links, Coal finds contacts (ADR 31).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import Mjcf, placement, read_mjcf, several_arms

from ibrobot_core.api import PlanCode, PlanningError, Robot, Vector
from ibrobot_planning.world.coal_shapes import convex, geometry
from ibrobot_planning.world.objects import Box, Capsule, Cylinder, Plane, Shape, Sphere

ADJACENT, ALWAYS, NEVER, SRDF = "Adjacent", "Always", "Never", "SRDF"
"""Reasons not to check a pair of links; the first three are those of MoveIt's setup assistant."""
_PLANE, _SPHERE, _CAPSULE, _CYLINDER, _BOX, _MESH = 0, 2, 3, 5, 6, 7
"""Values of mujoco.mjtGeom."""

type Pair = tuple[str, str]


@attrs.frozen(eq=False)
class LinkShape:
    """One shape of a link."""

    link: str
    joint: int
    """Pinocchio's number of the joint that moves it; 0: none."""
    placement: Vector
    """Pose in the frame of the joint, shape (4, 4)."""
    geometry: Any
    """The shape in Coal."""
    tree: int = 0
    """The tree of bodies to which the link belongs, e.g. one of two arms: MuJoCo's number of its root; 0: the world."""


def _indices() -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    return np.zeros(0, dtype=np.intp)


@attrs.frozen(eq=False)
class Followers:
    """Joints of the model that follow the robot's, e.g. the second finger of a gripper; F is their number."""

    columns: np.ndarray[tuple[int], np.dtype[np.intp]] = attrs.field(factory=_indices)
    """Index of each in Pinocchio's vector, shape (F,)."""
    leaders: np.ndarray[tuple[int], np.dtype[np.intp]] = attrs.field(factory=_indices)
    """Index of the joint that it follows among the robot's, shape (F,)."""
    factors: Vector = attrs.field(factory=lambda: np.zeros(0))
    """Shape (F,)."""
    offsets: Vector = attrs.field(factory=lambda: np.zeros(0))
    """[rad or m], shape (F,)."""


@attrs.frozen(eq=False, slots=False)
class Arm:
    """Joints, links and shapes. Vectors of joint positions have the order of `joint_names`."""

    joint_names: tuple[str, ...]
    model: Any
    """pinocchio.Model; its order of joints is that of the MJCF."""
    columns: np.ndarray[tuple[int], np.dtype[np.intp]]
    """Index of each joint in Pinocchio's vector, shape (J,)."""
    reference: Vector
    """Positions at which the joints have no effect [rad or m], shape (J,)."""
    lower: Vector
    """[rad or m], shape (J,)."""
    upper: Vector
    """[rad or m], shape (J,)."""
    shapes: tuple[LinkShape, ...]
    frames: dict[str, tuple[int, Vector]]
    """Link -> the joint that moves it, and its frame in that of the joint, shape (4, 4)."""
    numbers: np.ndarray[tuple[int], np.dtype[np.intp]]
    """Pinocchio's number of each joint, shape (J,)."""
    slides: np.ndarray[tuple[int], np.dtype[np.bool_]]
    """Which joints are prismatic, shape (J,)."""
    hulls: tuple[LinkShape, ...] = ()
    """Fewer shapes that contain `shapes`, for quick checks; may be empty. See `with_hulls`."""
    unchecked: Mapping[Pair, str] = attrs.field(factory=dict)
    """Pairs of links that may touch, with the reason; see `unchecked_pairs`."""
    urdf_links: Mapping[str, str] = attrs.field(factory=dict)
    """Link of the URDF -> link of the MJCF; empty without a URDF."""
    only_visible: tuple[str, ...] = ()
    """Links without collision geometry, of which the visible meshes' hulls count."""
    followers: Followers = Followers()
    unmoved: tuple[str, ...] = ()
    """Joints of the MJCF that neither are the robot's nor follow one of them: they stay at their reference."""

    def native(self, q: Vector) -> Vector:
        """Joint positions, shape (..., J), in Pinocchio's order and zero, shape (..., N)."""
        converted = np.empty((*q.shape[:-1], self.model.nq))
        converted[..., self.columns] = q - self.reference
        return self.followed(converted)

    def followed(self, native: Vector, *, motion: bool = False) -> Vector:
        """Fill in the followers' positions, or displacements if `motion`, in the array, shape (..., N); returns it."""
        each = self.followers
        if len(each.columns):
            followed = each.factors * native[..., self.columns[each.leaders]]
            native[..., each.columns] = followed if motion else followed + each.offsets
        return native

    @cached_property
    def effects(self) -> Vector:
        """How far Pinocchio's joints move with each of the robot's, shape (N, J)."""
        effects = np.zeros((self.model.nq, len(self.joint_names)))
        effects[self.columns, np.arange(len(self.joint_names))] = 1.0
        effects[self.followers.columns, self.followers.leaders] = self.followers.factors
        return effects

    @cached_property
    def slide(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which of Pinocchio's joints are prismatic, shape (N,)."""
        kinds = [joint.shortname() for joint in list(self.model.joints)[1:]]
        return np.array([kind == "JointModelPrismaticUnaligned" for kind in kinds], dtype=bool)

    @cached_property
    def travel(self) -> Vector:
        """Maximum displacement of each of Pinocchio's joints if it is prismatic, else 0 [m], shape (N,)."""
        own = np.maximum(np.abs(self.lower - self.reference), np.abs(self.upper - self.reference))
        farthest = np.abs(self.effects) @ own
        farthest[self.followers.columns] += np.abs(self.followers.offsets)
        return np.where(self.slide, farthest, 0.0)

    def link_pose(self, link: str, q: Vector) -> Vector:
        """Pose of a link in the base frame, shape (4, 4).

        Raises:
            PlanningError: for an unknown link.
        """
        joint, frame = self.frame(link)
        return np.asarray(self._joints(q)[joint].homogeneous @ frame)

    def placed_shapes(self, q: Vector) -> list[tuple[Any, Vector]]:
        """The shapes of all links with their poses in the base frame, shape (4, 4), at joint positions, shape (J,)."""
        joints = self._joints(q)
        return [(each.geometry, joints[each.joint].homogeneous @ each.placement) for each in self.shapes]

    def _joints(self, q: Vector) -> Any:
        """The pose of each of Pinocchio's joints at joint positions, shape (J,)."""
        import pinocchio

        data = self.model.createData()
        pinocchio.forwardKinematics(self.model, data, self.native(np.asarray(q, dtype=float)))
        return data.oMi

    def frame(self, link: str) -> tuple[int, Vector]:
        """The joint that moves a link, and the link's frame in that of the joint.

        Raises:
            PlanningError: for an unknown link.
        """
        if link not in self.frames:
            raise PlanningError(
                f"no link {link!r}; the links are: {', '.join(self.frames)}", PlanCode.INVALID_LINK_NAME
            )
        return self.frames[link]

    def hand(self, joint: str) -> tuple[str, ...]:
        """Links that move with a joint, the nearest to the joint first.

        For the last joint that moves the tool, these are the links of the gripper.
        """
        carried = {int(self.numbers[self.joint_names.index(joint)])}
        for number in range(min(carried) + 1, self.model.njoints):
            if self.model.parents[number] in carried:
                carried.add(number)
        return tuple(link for link, (number, _) in self.frames.items() if number in carried)

    def pairs(self) -> list[tuple[int, int]]:
        """Shapes of different links that can move towards one another, as indices of `shapes`."""
        return [(i, j) for (i, a), (j, b) in combinations(enumerate(self.shapes), 2) if a.joint != b.joint]

    def adjacent(self) -> set[Pair]:
        """Links that one joint connects, or moves side by side, e.g. the two fingers of a gripper."""
        connected, parents = set(), self.model.parents
        moving = [(), *(tuple(np.flatnonzero(row)) for row in self.effects)]
        for i, j in self.pairs():
            a, b = self.shapes[i], self.shapes[j]
            # All that stands has the joint 0, so there the base of another arm would count as connected, too.
            if a.tree != b.tree and a.tree and b.tree:
                continue
            beside = parents[a.joint] == parents[b.joint] and moving[a.joint] == moving[b.joint]
            if parents[a.joint] == b.joint or parents[b.joint] == a.joint or beside:
                connected.add(sorted_pair(a.link, b.link))
        return connected


def sorted_pair(a: str, b: str) -> Pair:
    """A key that is equal for (a, b) and (b, a)."""
    return (a, b) if a < b else (b, a)


def robot_arm(robot: Robot) -> Arm:
    """The arm of a robot, within the robot's joint limits.

    Raises:
        PlanningError: if the description has no MJCF, or the MJCF cannot be read or lacks a joint.
    """
    if robot.description.mjcf is None:
        raise PlanningError(
            f"robot {robot.name!r} has no robot.description.mjcf; planning around obstacles needs a MuJoCo model",
            PlanCode.COLLISION_CHECKING_UNAVAILABLE,
        )
    arm = read_arm(robot.description.mjcf, robot.joint_names, tuple(robot.description.arms.items()))
    return _limited(arm, tuple(robot.lower), tuple(robot.upper))


@lru_cache(maxsize=4)
def _limited(arm: Arm, lower: tuple[float, ...], upper: tuple[float, ...]) -> Arm:
    """The arm within limits [rad or m]: one and the same for equal limits, so that what is found out of it is, too."""
    return attrs.evolve(arm, lower=np.array(lower), upper=np.array(upper))


@lru_cache(maxsize=4)
def read_arm(path: Path, joints: tuple[str, ...], arms: tuple[tuple[str, tuple[float, ...]], ...] = ()) -> Arm:
    """An arm from an MJCF.

    Links without collision geometry, such as the base of the SO-101, get the convex hulls of their visible meshes.

    Args:
        path: the MJCF.
        joints: the joints that may move, in the order of vectors. Others follow them, or stay at their reference.
        arms: of several equal arms, prefix of its names and place of its base, as in `robot.description.arms`.

    Raises:
        PlanningError: if the file cannot be read, lacks a joint, or one is neither a hinge nor a slide.
    """
    import pinocchio

    try:
        mjcf = Mjcf(path, several_arms(path, dict(arms))) if arms else read_mjcf(path)
        source = mjcf.solid
        follow = mjcf.followers(source, joints)
        tree = mjcf.tree(source, (*joints, *follow))
    except KinematicsError as error:
        raise _unusable(str(error)) from error
    model = pinocchio.Model()
    for joint in tree.joints:
        kind = pinocchio.JointModelPrismaticUnaligned if joint.slides else pinocchio.JointModelRevoluteUnaligned
        model.addJoint(joint.parent + 1, kind(joint.axis), pinocchio.SE3(joint.placement), joint.name)
    numbers = [model.getJointId(name) for name in joints]
    moving = [tree.joints[number - 1] for number in numbers]
    bodies = [(carrier + 1, frame) for carrier, frame in tree.bodies]
    shapes = tuple(_shapes(source, bodies))
    if not shapes:
        raise _unusable(f"{path} has no geometry that could collide")
    limits = source.jnt_range[[source.joint(name).id for name in joints]]
    movable = (source.joint(number).name for number in range(source.njnt))
    return Arm(
        joint_names=joints,
        model=model,
        columns=np.array([model.joints[number].idx_q for number in numbers], dtype=np.intp),
        reference=np.array([joint.reference for joint in moving]),
        lower=limits[:, 0].copy(),
        upper=limits[:, 1].copy(),
        shapes=shapes,
        frames={source.body(body).name: place for body, place in enumerate(bodies)},
        numbers=np.array(numbers, dtype=np.intp),
        slides=np.array([joint.slides for joint in moving], dtype=bool),
        only_visible=mjcf.only_visible,
        followers=Followers(
            np.array([model.joints[model.getJointId(name)].idx_q for name in follow], dtype=np.intp),
            np.array([joints.index(each.leader) for each in follow.values()], dtype=np.intp),
            np.array([each.factor for each in follow.values()]),
            np.array([each.offset for each in follow.values()]),
        ),
        unmoved=tuple(name for name in movable if name not in joints and name not in follow),
    )


def _unusable(message: str) -> PlanningError:
    return PlanningError(message, PlanCode.COLLISION_CHECKING_UNAVAILABLE)


def _shapes(source: Any, bodies: Sequence[tuple[int, Vector]]) -> list[LinkShape]:
    shapes = []
    for geom in range(source.ngeom):
        if not (source.geom_contype[geom] or source.geom_conaffinity[geom]):
            continue
        body = int(source.geom_bodyid[geom])
        joint, frame = bodies[body]
        placed = frame @ placement(source.geom_pos[geom], source.geom_quat[geom])
        tree = int(source.body_rootid[body])
        shapes.append(LinkShape(source.body(body).name, joint, placed, _geometry(source, geom), tree))
    return shapes


def _geometry(source: Any, geom: int) -> Any:
    kind, size = int(source.geom_type[geom]), source.geom_size[geom]
    if kind == _MESH:
        return convex(*_hull(source, int(source.geom_dataid[geom])))
    shape: Shape
    if kind == _BOX:
        shape = Box(tuple((2 * size).tolist()))
    elif kind == _SPHERE:
        shape = Sphere(float(size[0]))
    elif kind == _CYLINDER:
        shape = Cylinder(float(size[0]), float(2 * size[1]))
    elif kind == _CAPSULE:
        shape = Capsule(float(size[0]), float(2 * size[1]))
    elif kind == _PLANE:
        shape = Plane()
    else:
        raise _unusable(f"geometry {source.geom(geom).name or geom} of the MJCF has a type that planning does not know")
    return geometry(shape)


def _hull(source: Any, mesh: int) -> tuple[Vector, np.ndarray[tuple[int, ...], np.dtype[np.intp]]]:
    """Vertices and triangles of a mesh's convex hull, as MuJoCo collides it (mesh_graph in mjmodel.h)."""
    first = int(source.mesh_vertadr[mesh])
    vertices = source.mesh_vert[first : first + int(source.mesh_vertnum[mesh])].astype(float)
    graph = source.mesh_graph[int(source.mesh_graphadr[mesh]) :]
    corners, faces = int(graph[0]), int(graph[1])
    used = graph[2 + corners : 2 + 2 * corners]
    triangles = graph[2 + 3 * corners + 3 * faces : 2 + 3 * corners + 6 * faces].reshape(-1, 3)
    order = np.argsort(used)
    return vertices[used], order[np.searchsorted(used, triangles, sorter=order)]


def reach(arm: Arm, carried: Sequence[LinkShape]) -> Vector:
    """Maximum distance of any point of the arm, and of what it carries, from each joint's axis [m], shape (J,).

    An upper bound, from bounding spheres of the shapes on a stretched-out arm; 1 for slide joints. With the motion of
    joints that follow.
    """
    model, farthest = arm.model, _farthest(arm).copy()
    for shape in carried:
        if shape.joint:
            farthest[shape.joint] = max(farthest[shape.joint], _away(shape))
    travel = np.concatenate([[0.0], arm.travel])
    for joint in range(model.njoints - 1, 0, -1):
        parent, away = model.parents[joint], np.linalg.norm(model.jointPlacements[joint].translation)
        farthest[parent] = max(farthest[parent], away + travel[joint] + farthest[joint])
    return np.asarray(np.where(arm.slide, 1.0, farthest[1:]) @ np.abs(arm.effects))


@lru_cache(maxsize=8)
def _farthest(arm: Arm) -> Vector:
    """Maximum distance of any point of the shapes on each of Pinocchio's joints from it [m]."""
    farthest = np.zeros(arm.model.njoints)
    for shape in arm.shapes:
        if shape.joint:
            farthest[shape.joint] = max(farthest[shape.joint], _away(shape))
    return farthest


def _away(shape: LinkShape) -> float:
    """Maximum distance of any point of a shape from its joint [m]."""
    shape.geometry.computeLocalAABB()
    centre = shape.placement[:3, :3] @ shape.geometry.aabb_center + shape.placement[:3, 3]
    return float(np.linalg.norm(centre) + shape.geometry.aabb_radius)
