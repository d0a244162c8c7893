"""The surroundings of the arm: objects with shapes, at poses in the base frame or attached to a link; all immutable.

A plan uses one `World`; changes make a new one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import attrs
import numpy as np
from ibrobot_kinematics.visible_names import name_fault
from numpy.typing import ArrayLike

from ibrobot_core.api import PlanCode, PlanningError, Pose, Vector, Vector3
from ibrobot_core.app import Bus, NoRequest, Service
from ibrobot_planning.world.ages import AgeSummary
from ibrobot_planning.world.bounds import FURTHEST

FLOOR = "floor"
"""Name of the object that the option `floor` of a planner adds."""
_LARGEST_M = 100.0
"""Sizes above this are most likely millimetres."""
_FLATTEST_M, _FLATTEST = 1e-9, 1e-6
"""Meshes flatter than this [m], or than this share of their largest coordinate, count as flat: Coal ends the process
when it makes the convex hull of one whose thickness is lost in rounding, e.g. of a tilted plate in single precision."""
_SQUARE = 1e-6
"""Allowed error of products of axes."""


def _positive(instance: object, attribute: attrs.Attribute[float], value: float) -> None:
    # Written so that NaN fails it.
    if not 0 < value <= _LARGEST_M:
        raise ValueError(f"{attribute.name} is {value} m, must be above 0 and at most {_LARGEST_M:g} m")


def _three(value: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(each) for each in value)


def _array(value: ArrayLike) -> Vector:
    return np.asarray(value, dtype=float)


def _names(value: Iterable[str]) -> frozenset[str]:
    return frozenset(value)


def _sizes(instance: object, attribute: attrs.Attribute[tuple[float, ...]], value: tuple[float, ...]) -> None:
    if len(value) != 3 or not all(0 < each <= _LARGEST_M for each in value):
        raise ValueError(
            f"{attribute.name} is {list(value)}, must be three lengths above 0 and at most {_LARGEST_M:g} m"
        )


@attrs.frozen
class Box:
    """A box about its origin."""

    size: tuple[float, ...] = attrs.field(converter=_three, validator=_sizes)
    """Whole lengths along x, y and z [m]."""


@attrs.frozen
class Sphere:
    """A sphere about its origin."""

    radius: float = attrs.field(validator=_positive)
    """[m]."""


@attrs.frozen
class Cylinder:
    """A cylinder about its origin, along z."""

    radius: float = attrs.field(validator=_positive)
    """[m]."""
    height: float = attrs.field(validator=_positive)
    """Whole length along z [m]."""


@attrs.frozen
class Capsule:
    """A cylinder with half spheres at its ends, about its origin, along z."""

    radius: float = attrs.field(validator=_positive)
    """[m]."""
    height: float = attrs.field(validator=_positive)
    """Length of the cylinder alone [m]."""


@attrs.frozen
class Plane:
    """Everything below z = 0 of its frame, e.g. a floor or a table without edges."""


@attrs.frozen(eq=False)
class Mesh:
    """Triangles. A body inside a closed mesh does not touch it, unless the mesh is `convex`.

    Raises:
        ValueError: for arrays of other shapes, vertices that are not finite, triangles of missing vertices, a mesh
            without area, or one that is more than 100 m across.
    """

    vertices: Vector = attrs.field(converter=_array)
    """[m], shape (N, 3)."""
    triangles: np.ndarray[tuple[int, ...], np.dtype[np.intp]] = attrs.field(converter=np.asarray)
    """Indices of vertices, shape (M, 3)."""
    convex: bool = False
    """Whether to take the convex hull instead: solid, and faster to check."""

    def __attrs_post_init__(self) -> None:
        vertices, triangles = self.vertices, self.triangles
        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 3:
            raise ValueError(f"vertices have shape {vertices.shape}, must be (N, 3) with at least three")
        if not np.isfinite(vertices).all():
            raise ValueError("vertices must be finite")
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
            raise ValueError(f"triangles have shape {triangles.shape}, must be (M, 3) with at least one")
        if not np.issubdtype(triangles.dtype, np.integer):
            raise ValueError(f"triangles are {triangles.dtype}, must be whole numbers")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            wrong = triangles.min() if triangles.min() < 0 else triangles.max()
            raise ValueError(f"a triangle names vertex {wrong}; there are {len(vertices)}, numbered from 0")
        extent = float(np.ptp(vertices, axis=0).max())
        if extent > _LARGEST_M:
            raise ValueError(f"the mesh is {extent:g} m across; for millimetres give scale: 0.001")
        corners = vertices[triangles]
        if not np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).max() > 0:
            raise ValueError("the mesh has no area")
        flat = max(_FLATTEST_M, _FLATTEST * float(np.abs(vertices).max()))
        if self.convex and np.linalg.matrix_rank(vertices - vertices.mean(axis=0), tol=flat) < 3:
            raise ValueError("a flat mesh has no convex hull; leave convex out")


@attrs.frozen(eq=False)
class Voxels:
    """Occupied cells of a grid that is aligned with its frame.

    Raises:
        ValueError: for indices of another shape or type, or none.
    """

    size: float = attrs.field(validator=_positive)
    """Edge of a cell [m]."""
    cells: np.ndarray[tuple[int, ...], np.dtype[np.int64]] = attrs.field(converter=np.asarray)
    """Indices of the occupied cells, shape (N, 3); cell (0, 0, 0) reaches from the origin to `size` along each axis."""

    def __attrs_post_init__(self) -> None:
        if self.cells.ndim != 2 or self.cells.shape[1] != 3 or not len(self.cells):
            raise ValueError(f"cells have shape {self.cells.shape}, must be (N, 3) with at least one")
        if not np.issubdtype(self.cells.dtype, np.integer):
            raise ValueError(f"cells are {self.cells.dtype}, must be whole numbers")

    @property
    def centres(self) -> Vector:
        """Centres of the cells [m], shape (N, 3)."""
        return np.asarray((self.cells + 0.5) * self.size)


_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
"""Of a box with lengths of 1, shape (8, 3)."""


@attrs.frozen(eq=False)
class Boxes:
    """Boxes that together contain a body, e.g. a mesh of very many triangles.

    Raises:
        ValueError: for arrays of other shapes, none, numbers that are not finite, or implausible sizes.
    """

    sizes: Vector = attrs.field(converter=_array)
    """Lengths along the axes of each [m], shape (N, 3)."""
    placements: Vector = attrs.field(converter=_array)
    """The middle of each [m], and the directions of its x, y and z axis, shape (N, 4, 3)."""

    def __attrs_post_init__(self) -> None:
        count = len(self.sizes)
        if not count or self.sizes.shape != (count, 3) or self.placements.shape != (count, 4, 3):
            raise ValueError(f"{self.sizes.shape} sizes and {self.placements.shape} placements, need (N, 3), (N, 4, 3)")
        # Written so that NaN fails it.
        if not ((self.sizes > 0) & (self.sizes <= _LARGEST_M)).all() or not np.isfinite(self.placements).all():
            raise ValueError(f"boxes have lengths above 0, at most {_LARGEST_M:g} m, and finite places")
        axes = self.placements[:, 1:]
        if np.abs(axes @ axes.transpose(0, 2, 1) - np.eye(3)).max() > _SQUARE or (np.linalg.det(axes) < 0).any():
            raise ValueError("the axes of boxes are directions at right angles, right-handed")

    @property
    def corners(self) -> Vector:
        """Of each [m], shape (N, 8, 3)."""
        within = _CORNERS * self.sizes[:, None]
        return np.asarray(within @ self.placements[:, 1:] + self.placements[:, :1])


type Shape = Box | Sphere | Cylinder | Capsule | Plane | Mesh | Voxels | Boxes
SIMPLE: Mapping[Literal["box", "sphere", "cylinder", "capsule", "plane"], type[Any]] = {
    "box": Box, "sphere": Sphere, "cylinder": Cylinder, "capsule": Capsule, "plane": Plane,
}  # fmt: skip
"""The shapes of a simulated scene."""


@attrs.frozen
class WorldObject:
    """A shape at a pose."""

    shape: Shape
    pose: Pose = Pose()
    """In the base frame, or in the frame of `link`."""
    link: str | None = None
    """The link that carries it, e.g. the gripper; None: it stands in the base frame."""
    may_touch: frozenset[str] = attrs.field(default=frozenset(), converter=_names)
    """Links and objects that it may touch."""
    movable: bool = False
    """Whether a guard lets the hand touch it; planners keep away nevertheless."""

    def __attrs_post_init__(self) -> None:
        p, o = self.pose.position, self.pose.orientation
        if not np.isfinite([p.x, p.y, p.z, o.x, o.y, o.z, o.w]).all():
            raise ValueError("the pose must be finite")
        if max(abs(p.x), abs(p.y), abs(p.z)) > FURTHEST:
            raise ValueError(f"the position is {p.x:g}, {p.y:g}, {p.z:g} m, at most {FURTHEST:g} m away")
        length = math.hypot(o.x, o.y, o.z, o.w)
        if abs(length - 1) > 1e-3:
            raise ValueError(f"the orientation is a quaternion of length {length:.3g}, must be 1")


@attrs.frozen
class World:
    """Objects by name. Every method returns a new world."""

    objects: Mapping[str, WorldObject] = attrs.field(factory=dict)

    def add(self, name: str, thing: WorldObject) -> World:
        """The world with another object.

        Raises:
            PlanningError: for a name that is taken, or that not everybody would read the same.
        """
        if fault := name_fault(name):
            raise PlanningError(f"an object needs a name: {fault}", PlanCode.INVALID_OBJECT_NAME)
        if name in self.objects:
            raise PlanningError(f"there is an object {name!r} already", PlanCode.INVALID_OBJECT_NAME)
        return World({**self.objects, name: thing})

    def remove(self, name: str) -> World:
        """The world without an object; others lose the permission to touch it.

        Raises:
            PlanningError: for a name that no object has, as in the methods below.
        """
        self.named(name)
        others = {key: value for key, value in self.objects.items() if key != name}
        return World(
            {
                key: attrs.evolve(value, may_touch=value.may_touch - {name}) if name in value.may_touch else value
                for key, value in others.items()
            }
        )

    def move(self, name: str, pose: Pose) -> World:
        """The world with an object at another pose, in the same frame."""
        return World({**self.objects, name: attrs.evolve(self.named(name), pose=pose)})

    def attach(self, name: str, link: str, pose: Pose, may_touch: frozenset[str] = frozenset()) -> World:
        """The world with an object carried by `link`, at `pose` in its frame; it may touch the link and `may_touch`.

        Raises:
            PlanningError: for a name that no object has, or an object that is attached already.
        """
        thing = self.named(name)
        if thing.link is not None:
            raise PlanningError(f"object {name!r} is attached to {thing.link!r} already", PlanCode.INVALID_OBJECT_NAME)
        touching = thing.may_touch | may_touch | {link}
        return World({**self.objects, name: attrs.evolve(thing, link=link, pose=pose, may_touch=touching)})

    def detach(self, name: str, pose: Pose, may_touch: frozenset[str] = frozenset()) -> World:
        """The world with an attached object put down at `pose` in the base frame; it may touch only `may_touch`.

        Raises:
            PlanningError: for a name that no object has, or an object that is not attached.
        """
        thing = self.named(name)
        if thing.link is None:
            raise PlanningError(f"object {name!r} is not attached", PlanCode.INVALID_OBJECT_NAME)
        return World({**self.objects, name: attrs.evolve(thing, link=None, pose=pose, may_touch=may_touch)})

    def allow(self, name: str, may_touch: frozenset[str]) -> World:
        """The world with an object that may touch `may_touch` and the link that carries it, and nothing else."""
        thing = self.named(name)
        carrier = frozenset() if thing.link is None else frozenset({thing.link})
        return World({**self.objects, name: attrs.evolve(thing, may_touch=may_touch | carrier)})

    def check(self, links: Collection[str], others: Collection[str] | None = None) -> None:
        """Check the names of objects, and the names that they refer to, for a robot.

        Args:
            links: names of the robot's links.
            others: names of temporary objects that may be touched; None: any name.

        Raises:
            PlanningError: for an object that is named like a link, or that names an unknown link or object.
        """
        for name, thing in self.objects.items():
            if name in links:
                raise PlanningError(f"an object has the name of link {name!r}", PlanCode.INVALID_OBJECT_NAME)
            if thing.link is not None and thing.link not in links:
                raise PlanningError(
                    f"object {name!r}: no link {thing.link!r}; the links are: {', '.join(links)}",
                    PlanCode.INVALID_LINK_NAME,
                )
            unknown = [] if others is None else sorted(thing.may_touch.difference(links, self.objects, others))
            if unknown:
                raise PlanningError(
                    f"object {name!r} may touch {unknown[0]!r}, which is neither a link nor an object;"
                    f" available: {', '.join((*links, *self.objects))}",
                    PlanCode.INVALID_LINK_NAME,
                )

    def named(self, name: str) -> WorldObject:
        """An object.

        Raises:
            PlanningError: for a name that no object has.
        """
        if name not in self.objects:
            raise PlanningError(
                f"no object {name!r}; the objects are: {', '.join(self.objects) or 'none'}",
                PlanCode.INVALID_OBJECT_NAME,
            )
        return self.objects[name]


@attrs.frozen
class ObservedWorld:
    """The objects around the robot as they were last seen, and how long ago."""

    world: World = World()
    ages: Mapping[str, AgeSummary] = attrs.field(factory=dict)
    """Cloud or object -> its age; without objects that never get too old."""
    refusal: str = ""
    """Why plans are refused, and what to do about it; empty if they are not."""
    is_awaited: bool = False
    """Whether a cloud has not come yet, shortly after the start of the run."""


SNAPSHOT = Service(
    "/world/snapshot",
    NoRequest,
    World,
    "The objects around the robot; an error if they are too old to plan with.",
    reads=True,
)
OBSERVED = Service(
    "/world/observed",
    NoRequest,
    ObservedWorld,
    "The objects around the robot, and their ages, however old they are.",
    reads=True,
)


def world_of(bus: Bus | None, otherwise: Callable[[], World] = World) -> World:
    """The objects around the robot, for plans; those of `otherwise`, by default none, without the section `world`.

    Raises:
        PlanningError: if a part of the world is too old, and its rule is to refuse plans.
    """
    return bus.call(SNAPSHOT) if bus is not None and bus.serves(SNAPSHOT) else otherwise()


def with_floor(world: World, floor: float | None) -> World:
    """The world with a floor at a height [m], unless it has one; None: no floor."""
    named = world.objects.get(FLOOR)
    if floor is None or (named is not None and isinstance(named.shape, Plane)):
        return world
    # Another object of this name does not take the table's place.
    return world.add(
        FLOOR if named is None else f"{FLOOR} of the planner", WorldObject(Plane(), Pose(Vector3(0.0, 0.0, floor)))
    )


def observed_world(bus: Bus) -> ObservedWorld:
    """The objects around the robot however old they are, e.g. to show them."""
    return bus.call(OBSERVED) if bus.serves(OBSERVED) else ObservedWorld()


def read_mesh(path: Path, scale: float = 1.0, *, convex: bool = False) -> Mesh:
    """A mesh from a file, e.g. STL, OBJ or PLY.

    Args:
        path: the file.
        scale: factor of its numbers, e.g. 0.001 for millimetres.
        convex: whether to take the convex hull.

    Raises:
        ValueError: if the file cannot be read, or has no usable triangles.
    """
    import coal

    try:
        exists = path.is_file()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    if not exists:
        raise ValueError(f"no file {path}")
    if not scale > 0:
        raise ValueError(f"scale is {scale}, must be above 0")
    try:
        model = coal.MeshLoader().load(str(path), np.full(3, scale))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path} cannot be read as a mesh: {_reason(error, path)}") from error
    triangles = [[model.tri_indices(i)[k] for k in range(3)] for i in range(model.num_tris)]
    try:
        return Mesh(np.array(model.vertices()), np.array(triangles, dtype=np.intp).reshape(-1, 3), convex)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _reason(error: Exception, path: Path) -> str:
    """Assimp's reason, without the lines that Coal adds."""
    lines = str(error).strip().splitlines()
    begin = next((i + 1 for i, line in enumerate(lines) if "Could not load resource" in line), 0)
    text = " ".join(line.strip() for line in lines[begin:] if not line.startswith("Hint:"))
    text = text.replace(f' "{path}"', "").replace(f" for {path}", "").rstrip(".")
    if "No suitable reader" in text:
        return f"{text}; use STL, OBJ or PLY"
    return text or "it has no triangles"
