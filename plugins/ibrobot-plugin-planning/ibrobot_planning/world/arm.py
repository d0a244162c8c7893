"""The collision model of the arm: joints and the shapes of its links, from the MJCF.

Pinocchio places the links, Coal finds contacts (ADR 31).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import Mjcf, placement, read_mjcf, several_arms

from ibrobot_core.api import PlanningError, Robot, Vector
from ibrobot_core.app import PlanCode
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


@attrs.frozen(eq=False)
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

    def native(self, q: Vector) -> Vector:
        """Joint positions, shape (..., J), in Pinocchio's order and zero."""
        converted = np.empty(q.shape)
        converted[..., self.columns] = q - self.reference
        return converted

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
        """Links that one joint connects."""
        connected = set()
        for i, j in self.pairs():
            a, b = self.shapes[i], self.shapes[j]
            # All that stands has the joint 0, so there the base of another arm would count as connected, too.
            if a.tree != b.tree and a.tree and b.tree:
                continue
            if self.model.parents[a.joint] == b.joint or self.model.parents[b.joint] == a.joint:
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
    return attrs.evolve(arm, lower=robot.lower, upper=robot.upper)


@lru_cache(maxsize=4)
def read_arm(path: Path, joints: tuple[str, ...], arms: tuple[tuple[str, tuple[float, ...]], ...] = ()) -> Arm:
    """An arm from an MJCF.

    Links without collision geometry, such as the base of the SO-101, get the convex hulls of their visible meshes.

    Args:
        path: the MJCF.
        joints: the joints that may move, in the order of vectors. Others stay at their reference position.
        arms: of several equal arms, prefix of its names and place of its base, as in `robot.description.arms`.

    Raises:
        PlanningError: if the file cannot be read, lacks a joint, or one is neither a hinge nor a slide.
    """
    import pinocchio

    try:
        mjcf = Mjcf(path, several_arms(path, dict(arms))) if arms else read_mjcf(path)
        source = mjcf.solid
        tree = mjcf.tree(source, joints)
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

    An upper bound, from bounding spheres of the shapes on a stretched-out arm; 1 for slide joints.
    """
    model, farthest = arm.model, _farthest(arm).copy()
    for shape in carried:
        if shape.joint:
            farthest[shape.joint] = max(farthest[shape.joint], _away(shape))
    for joint in range(model.njoints - 1, 0, -1):
        parent, away = model.parents[joint], np.linalg.norm(model.jointPlacements[joint].translation)
        farthest[parent] = max(farthest[parent], away + farthest[joint])
    return np.where(arm.slides, 1.0, farthest[arm.numbers])


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
