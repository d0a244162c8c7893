"""Parts of the world, each with its pairs: a change of the world makes again only the parts that it concerns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import batched, product
from typing import Any, Self

import attrs
import coal
import numpy as np
import pinocchio
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import Vector
from ibrobot_planning.world.arm import Arm, LinkShape, Pair
from ibrobot_planning.world.checked_arm import link_hulls
from ibrobot_planning.world.coal_shapes import boxes, geometry, hull
from ibrobot_planning.world.collision import Engine, checked_pairs, object_shapes
from ibrobot_planning.world.objects import Box, Boxes, Voxels, World, WorldObject

type Cells = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

_MOST = 16
"""Objects of a part, or blocks of cells: one call that makes a part takes no longer, and the loop waits for calls."""
_BLOCK = 3
"""Edge of a block of cells, in cells; it counts as the convex hull of its cells."""
_MOST_BLOCKS = 2000
"""Blocks of a cloud; of one that has more, blocks are larger."""
_LARGEST = 2**62
"""Cells of a grid whose numbers are certainly whole numbers of numpy."""
_CORNERS = np.array(list(product((0, 1), repeat=3)))
"""Of a cell, from its index on."""
_CONVEX = (coal.Halfspace, coal.Box, coal.Sphere, coal.Capsule, coal.Cylinder, coal.ConvexBase)


@attrs.frozen(eq=False)
class Moving:
    """The shapes of a robot and of what it carries."""

    arm: Arm
    carried: World
    moved: Sequence[LinkShape]
    """Those that joints move, S in number."""
    still: Sequence[LinkShape]
    """The others, e.g. of the base."""
    levers: Vector
    """The result of `_levers`, shape (S, N)."""
    coarse: Moving | None = None
    """With one hull in place of the shapes of each link, for clouds, whose many blocks are coarse themselves."""

    @classmethod
    def of(cls, arm: Arm, carried: World) -> Self:
        """Those of an arm, and of objects with links."""
        links: dict[str, list[LinkShape]] = {}
        for shape in arm.shapes:
            links.setdefault(shape.link, []).append(shape)
        hulls = [shape for shapes in links.values() for shape in link_hulls(shapes)]
        return cls._made(arm, carried, arm.shapes, cls._made(arm, carried, hulls, None))

    @classmethod
    def _made(cls, arm: Arm, carried: World, links: Sequence[LinkShape], coarse: Moving | None) -> Self:
        shapes = [*links, *object_shapes(arm, carried)]
        moved = [shape for shape in shapes if shape.joint]
        return cls(arm, carried, moved, [shape for shape in shapes if not shape.joint], _levers(arm, moved), coarse)


class Part:
    """Pairs of what moves and some objects that stand or, without these, of the robot itself and what it carries.

    P is their number. Pinocchio's structures are those of one thread at a time.

    Args:
        moving: what moves.
        objects: the objects that stand.
        blocks: names of objects, each with one of several shapes of Coal in place of the object's own, and its place in
            the object's frame.
    """

    def __init__(
        self, moving: Moving, objects: Mapping[str, WorldObject], blocks: Sequence[tuple[str, Any, Vector]] = ()
    ) -> None:
        arm, self.objects = moving.arm, dict(objects)
        self._model = arm.model
        standing = [
            LinkShape(name, 0, matrix(objects[name].pose) @ within, shape)
            for name, shape, within in blocks
            or [(name, geometry(thing.shape), np.eye(4)) for name, thing in objects.items()]
        ]
        count = len(moving.moved)
        shapes = [*moving.moved, *(standing or moving.still)]
        world = World({**moving.carried.objects, **objects})
        checked, margins = checked_pairs(world, shapes, 0.0, 0.0, arm.unchecked)
        if standing:
            checked[:count, :count] = False
        self.geometry = Engine(arm.model, None, shapes, checked, margins).geometry
        self.results = self.geometry.createData()
        pairs = self.geometry.collisionPairs
        first = np.array([pair.first for pair in pairs], dtype=np.intp)
        second = np.array([pair.second for pair in pairs], dtype=np.intp)
        self.ends = np.stack([first, second], axis=1)
        """The shapes of each pair, shape (P, 2)."""
        self.names: Sequence[Pair] = [(shapes[a].link, shapes[b].link) for a, b in self.ends.tolist()]
        levers = np.zeros((len(shapes), arm.model.nq))
        levers[:count] = moving.levers
        a, b = levers[first], levers[second]
        both = (a > 0) & (b > 0)  # a joint that moves both does not change their distance
        self.moves: Vector = np.stack([np.where(both, 0.0, a > 0), np.where(both, 0.0, b > 0)], axis=1)
        """Whether each of Pinocchio's joints moves the first and the second shape of a pair, not both: (P, 2, N)."""
        self.levers: Vector = np.where(both, 0.0, a + b) @ np.abs(arm.effects)
        """Largest motion of each pair per joint [m/rad], shape (P, J)."""
        bounded = [_has_sphere(shape) for shape in shapes]
        self.centres: Sequence[Vector] = [
            shape.geometry.aabb_center if known else np.zeros(3) for shape, known in zip(shapes, bounded, strict=True)
        ]
        """Of bounding spheres, each in the frame of its shape [m]."""
        self._spheres: Vector = np.array(
            [shape.geometry.aabb_radius if known else np.inf for shape, known in zip(shapes, bounded, strict=True)]
        )
        """Their radii [m]."""
        self.radii: Vector = np.where(np.arange(len(shapes)) < count, self._spheres, 0.0)[self.ends]
        """Of the shapes of each pair that move, shape (P, 2) [m]."""
        convex = np.array([isinstance(shape.geometry, _CONVEX) for shape in shapes], dtype=bool)
        self.convex = convex[self.ends].all(axis=1)
        """Whether both shapes of each pair are convex, shape (P,)."""
        self._numbers: dict[str, list[int]] = {name: [] for name in objects}
        for number in range(count, count + len(standing)):
            self._numbers[shapes[number].link].append(number)
        self._within = [block[2] for block in blocks] or [np.eye(4)] * len(standing)
        self._first = count

    def place(self, data: Any) -> None:
        """Have all shapes where the joints of a pinocchio.Data are."""
        pinocchio.updateGeometryPlacements(self._model, data, self.geometry, self.results)

    def apart(self, data: Any) -> Vector:
        """Distances of bounding spheres where the joints of a pinocchio.Data are [m], shape (P,)."""
        self.place(data)
        placed = np.array([at.act(centre) for at, centre in zip(self.results.oMg, self.centres, strict=True)])
        ends = placed[self.ends]
        between: Vector = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) - self._spheres[self.ends].sum(axis=1)
        return between

    def of(self, names: Iterable[str]) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """The pairs of some objects."""
        numbers = [number for name in names for number in self._numbers[name]]
        return np.flatnonzero(np.isin(self.ends, numbers).any(axis=1))

    def move(self, placements: Mapping[str, Any]) -> None:
        """Have objects at placements, each a pinocchio.SE3."""
        for name, placement in placements.items():
            for number in self._numbers[name]:
                within = pinocchio.SE3(self._within[number - self._first])
                self.geometry.geometryObjects[number].placement = placement * within


def parts(moving: Moving, standing: Mapping[str, WorldObject], before: Sequence[Part]) -> Iterator[Part]:
    """The parts of a world, those of `before` that have not changed among them; the same parts count for one thread."""
    left, made, small = dict(standing), set[str](), list[Part]()
    for part in before:
        if not all(name in left and _alike(left[name], thing) for name, thing in part.objects.items()):
            continue
        if (
            any(isinstance(thing.shape, Voxels | Boxes) for thing in part.objects.values())
            or len(part.objects) == _MOST
        ):
            made.update(part.objects)
            yield part
        else:
            small.append(part)
    simple: list[tuple[str, WorldObject]] = []
    for name, thing in left.items():
        if name in made:
            continue
        if isinstance(thing.shape, Voxels | Boxes):
            for blocks in batched(_blocks(thing.shape), _MOST):
                yield Part(moving.coarse or moving, {name: thing}, [(name, *block) for block in blocks])
        else:
            simple.append((name, thing))
    for some in batched(simple, _MOST):
        objects = dict(some)
        yield next((part for part in small if part.objects.keys() == objects.keys()), None) or Part(moving, objects)


def _alike(a: WorldObject, b: WorldObject) -> bool:
    """Whether two objects are equal; cells by their values."""
    if isinstance(a.shape, Voxels) and isinstance(b.shape, Voxels) and a.shape is not b.shape:
        if a.shape.size != b.shape.size or not np.array_equal(a.shape.cells, b.shape.cells):
            return False
        a = attrs.evolve(a, shape=b.shape)
    return a == b


def _blocks(shape: Voxels | Boxes) -> Iterator[tuple[Any, Vector]]:
    """Shapes of Coal that together contain one, each with its place in the frame of the object."""
    return _blocks_of_cells(shape) if isinstance(shape, Voxels) else boxes(shape)


def _blocks_of_cells(cloud: Voxels) -> Iterator[tuple[Any, Vector]]:
    """Neighbouring cells in one shape; a convex one takes a fiftieth of the time of an octree."""
    edge, cells = _BLOCK, _unique(cloud.cells)[0]
    while True:
        which = _unique(cells // edge)[1]
        if which.max() < _MOST_BLOCKS:
            break
        edge *= 2
    order = np.argsort(which, kind="stable")
    cells, begins = cells[order], np.flatnonzero(np.diff(which[order], prepend=-1))
    lowest, highest = np.minimum.reduceat(cells, begins), np.maximum.reduceat(cells, begins) + 1
    is_box = np.prod(highest - lowest, axis=1) == np.diff(begins, append=len(cells))
    for number, block in enumerate(np.split(cells, begins[1:])):
        low, high, placed = lowest[number], highest[number], np.eye(4)
        if is_box[number]:
            placed[:3, 3] = (low + high) / 2 * cloud.size
            yield geometry(Box(tuple((high - low) * cloud.size))), placed
            continue
        placed[:3, 3] = low * cloud.size
        corners = (block[:, None] - low + _CORNERS).reshape(-1, 3)
        _, first = np.unique(corners @ (1, edge + 1, (edge + 1) ** 2), return_index=True)
        yield hull(corners[first] * cloud.size), placed


def _unique(cells: Cells) -> tuple[Cells, Cells]:
    """The different rows in order, shape (N, 3), and which of them each row is; the loop waits for sorting rows."""
    low, sizes = cells.min(axis=0), np.ptp(cells, axis=0) + 1
    if math.prod(sizes.tolist()) >= _LARGEST:
        rows, which = np.unique(cells, axis=0, return_inverse=True)
        return rows, which.reshape(-1)
    numbers, which = np.unique(np.ravel_multi_index((cells - low).T, sizes), return_inverse=True)
    return np.stack(np.unravel_index(numbers, sizes), axis=1) + low, which


def _has_sphere(shape: LinkShape) -> bool:
    """Whether a bounding sphere of a shape is known; it computes it."""
    shape.geometry.computeLocalAABB()
    return bool(np.isfinite(shape.geometry.aabb_radius))


def _levers(arm: Arm, shapes: Sequence[LinkShape]) -> Vector:
    """Largest distance of any point of each shape from each joint's axis [m]; 1 for slides, 0 if it does not move.

    Of Pinocchio's joints, shape (S, N). Upper bounds for all configurations, from bounding spheres on a stretched-out
    arm.
    """
    model = arm.model
    levers = np.zeros((len(shapes), model.nq))
    for row, shape in zip(levers, shapes, strict=True):
        joint = shape.joint
        shape.geometry.computeLocalAABB()
        centre = shape.placement[:3, :3] @ shape.geometry.aabb_center + shape.placement[:3, 3]
        away = float(np.linalg.norm(centre) + shape.geometry.aabb_radius)
        while joint:
            row[joint - 1] = 1.0 if arm.slide[joint - 1] else away
            away += arm.travel[joint - 1] + float(np.linalg.norm(model.jointPlacements[joint].translation))
            joint = int(model.parents[joint])
    return levers
