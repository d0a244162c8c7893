"""What the guard lets the arm touch: the table, what is movable, and what lies in certain regions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import product

import attrs
import numpy as np
from ibrobot_kinematics import robot_model
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import Pose, Robot, Vector, Vector3
from ibrobot_planning.guard.options import ClearanceGuardOptions, RegionOptions
from ibrobot_planning.world.arm import Arm, Pair, sorted_pair
from ibrobot_planning.world.coal_shapes import enclosing, geometry
from ibrobot_planning.world.objects import FLOOR, Boxes, Mesh, Plane, Voxels, World, WorldObject

_OTHER_FLOOR = f"{FLOOR} of the world"
"""An object that is named like the table, beside it: it does not take its place."""
_ROUNDING_M = 1e-6
"""How far an object in a region may reach beyond it [m]."""
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
"""Of a cube of length 1."""


def hands(robot: Robot, arm: Arm) -> tuple[str, ...]:
    """The links behind the last joint that moves the tool, of each arm; none for a model without the tool."""
    prefixes = tuple(robot.description.arms) or ("",)
    links: list[str] = []
    for prefix in prefixes:
        joints = [name for name in robot.joint_names if robot.description.arm_of(name) == prefix]
        try:
            model = robot_model(robot, joints)
        except KinematicsError:  # e.g. a tip of the URDF alone
            continue
        links += arm.hand(model.joint_names[model.chain[-1].index]) if model.chain else ()
    return tuple(links)


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
        others = {_OTHER_FLOOR if name in self._fixed else name: thing for name, thing in world.objects.items()}
        objects = {**self._fixed, **others}
        return World({name: thing for given in objects.items() for name, thing in self._permitted(*given)})

    def _permitted(self, name: str, thing: WorldObject) -> Iterator[tuple[str, WorldObject]]:
        """An object with what may touch it; cells that lie in a region are an object of their own."""
        free = self._options.free
        if free is not None:
            thing = _touchable(thing, free.get(FLOOR if name == _OTHER_FLOOR else name, ()))
        elif thing.movable:
            thing = _touchable(thing, self._hands)
        for region, box in self._options.regions.items() if thing.link is None else ():
            links = self._hands if box.links is None else box.links
            inside = _within(thing, box)
            if not isinstance(thing.shape, Voxels):
                thing = _touchable(thing, links) if inside.all() else thing
            elif inside.any():
                cells = thing.shape.cells
                within = attrs.evolve(thing, shape=Voxels(thing.shape.size, cells[inside]))
                yield f"{name} in {region}", _touchable(within, links)
                if inside.all():
                    return
                thing = attrs.evolve(thing, shape=Voxels(thing.shape.size, cells[~inside]))
        yield name, thing


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
