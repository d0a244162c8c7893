"""What the guard lets the arm touch: the table, what is movable, and what lies in certain regions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import product

import attrs
import numpy as np
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import Pose, Robot, Vector, Vector3
from ibrobot_planning.guard.options import ClearanceGuardOptions, RegionOptions
from ibrobot_planning.world.arm import Arm, Pair, sorted_pair
from ibrobot_planning.world.coal_shapes import enclosing, geometry
from ibrobot_planning.world.hands import hands
from ibrobot_planning.world.objects import FLOOR, Boxes, Mesh, Plane, Voxels, World, WorldObject

_OTHER_FLOOR = f"{FLOOR} of the world"
"""An object that is named like the table, beside it: it does not take its place."""
_ROUNDING_M = 1e-6
"""How far an object in a region may reach beyond it [m]."""
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
"""Of a cube of length 1."""


class Permissions:
    """The table, and what may be touched, by the options of the guard.

    Attributes:
        pressed: pair -> how deep commands may lie in one another [m].
    """

    def __init__(self, options: ClearanceGuardOptions, robot: Robot, arm: Arm) -> None:
        self._options, self._hands = options, hands(robot, arm)
        floor = robot.description.floor if options.floor is None else options.floor
        if options.base is not None:  # it stands on its floor
            floor = None
        self._fixed = {} if floor is None else {FLOOR: WorldObject(Plane(), Pose(Vector3(0.0, 0.0, floor)))}
        may_touch = {FLOOR: self._hands} if options.may_touch is None else options.may_touch
        if FLOOR in may_touch:
            may_touch = {**may_touch, _OTHER_FLOOR: may_touch[FLOOR]}
        self.pressed: Mapping[Pair, float] = {
            sorted_pair(name, other): options.press for name, others in may_touch.items() for other in others
        }

    def applied(self, world: World) -> World:
        """A world with the table, and with what may be touched without limit."""
        objects = dict(self._fixed)
        for name, thing in world.objects.items():
            own = name
            if self._fixed and name in (FLOOR, _OTHER_FLOOR):
                own = _OTHER_FLOOR if name == FLOOR else _new_name(name, world.objects)
            for known, part in self._permitted(name, own, thing):
                objects[known if known == own else _new_name(known, world.objects.keys() | objects.keys())] = part
        return World(objects)

    def _permitted(self, name: str, own: str, thing: WorldObject) -> Iterator[tuple[str, WorldObject]]:
        """An object with what may touch it; the cells in the same regions become a separate object.

        Args:
            name: its name in the world.
            own: its name in the guard, unless its cells are divided.
            thing: the object.
        """
        free = self._options.free
        if free is not None:
            thing = _touchable(thing, free.get(name, ()))
        elif thing.movable:
            thing = _touchable(thing, self._hands)
        if thing.link is not None or not self._options.regions:
            yield own, thing
            return
        regions = list(self._options.regions.items())
        lies_in = np.array([_within(thing, box) for _, box in regions])
        divided = np.unique(lies_in, axis=1).T if isinstance(thing.shape, Voxels) else lies_in.all(axis=1)[None]
        for each in divided.tolist():
            within = [(region, box) for (region, box), is_in in zip(regions, each, strict=True) if is_in]
            part = thing
            if isinstance(thing.shape, Voxels):
                cells = thing.shape.cells[(each == lies_in.T).all(axis=1)]
                part = attrs.evolve(thing, shape=Voxels(thing.shape.size, cells))
            for _, box in within:
                part = _touchable(part, self._hands if box.links is None else box.links)
            if within and isinstance(thing.shape, Voxels):
                yield f"{name} in {' and '.join(region for region, _ in within)}", part
            else:
                yield own, part


def _new_name(name: str, taken: Collection[str]) -> str:
    """A name that no object has: of two objects with one name, one would replace the other."""
    while name in taken:
        name += "'"
    return name


def _touchable(thing: WorldObject, by: Iterable[str]) -> WorldObject:
    """An object that these may touch, too."""
    return attrs.evolve(thing, may_touch=thing.may_touch.union(by))


def _within(thing: WorldObject, box: RegionOptions) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each cell of a standing object, or the whole of another one, lies in a region; shape (N,)."""
    points = _points(thing)
    if points is None:
        return np.zeros(1, dtype=bool)
    placed = matrix(thing.pose)
    points = points @ placed[:3, :3].T + placed[:3, 3]
    inside = (points >= np.array(box.lower) - _ROUNDING_M) & (points <= np.array(box.upper) + _ROUNDING_M)
    return np.asarray(inside.all(axis=(1, 2)))


def _points(thing: WorldObject) -> Vector | None:
    """Corners of each cell, or of a hull of the whole, in the object's frame [m], shape (N, C, 3); None: no end."""
    match thing.shape:
        case Voxels() as cells:
            return np.asarray(cells.centres[:, None] + _CORNERS * cells.size)
        case Mesh() as mesh:
            return mesh.vertices[None]
        case Boxes() as several:
            return several.corners
        case shape:
            points = enclosing(geometry(shape))
            return None if points is None else points[None]
