"""Changes of the world as messages between processes: plain values, arrays as text."""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Self

import attrs
import numpy as np

from ibrobot_core.api import HardwareError, Pose, Quaternion, Vector3
from ibrobot_planning.guard.meshes import is_large
from ibrobot_planning.world.bounds import FURTHEST
from ibrobot_planning.world.objects import SIMPLE, Boxes, Mesh, Shape, Voxels, World, WorldObject

_NAMES: Mapping[type[Any], str] = {kind: name for name, kind in SIMPLE.items()}
_CELLS, _FEWER_CELLS = ("<i2", "<i8"), 2**15
"""Types of the indices of cells; the first suffices below a limit, and control reads it in a quarter of the time."""
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""


@attrs.frozen(eq=False)
class WorldChange:
    """Objects that are new or other than before, those that are gone, and what is too old to rely on."""

    changed: Mapping[str, WorldObject]
    removed: tuple[str, ...] = ()
    stale: str = ""
    """Why the world is not known well enough; empty if it is."""
    moved: Mapping[str, Pose] = attrs.field(factory=dict)
    """Objects of which nothing else has changed, and where they are now; unknown ones do not count."""

    @classmethod
    def between(cls, before: World, after: World, stale: str = "") -> Self:
        """What makes one world of another."""
        changed, moved = dict[str, WorldObject](), dict[str, Pose]()
        for name, thing in after.objects.items():
            known = before.objects.get(name)
            if known is not None and attrs.evolve(known, pose=thing.pose) == thing:
                moved |= {name: thing.pose} if known.pose != thing.pose else {}
            else:
                changed[name] = thing
        return cls(changed, tuple(name for name in before.objects if name not in after.objects), stale, moved)

    def apply(self, world: World) -> World:
        """The world after the change; the same object if it stays as it is."""
        if not self.changed and not self.removed and not self.moved:
            return world
        kept = {name: thing for name, thing in world.objects.items() if name not in self.removed}
        moved = {name: attrs.evolve(kept[name], pose=pose) for name, pose in self.moved.items() if name in kept}
        return World({**kept, **moved, **self.changed})

    def parts(self, size: int) -> Iterator[Self]:
        """The same as several changes of at most so many new shapes each."""
        items = list(self.changed.items())
        yield attrs.evolve(self, changed=dict(items[:size]))
        for begin in range(size, len(items), size):
            yield attrs.evolve(self, changed=dict(items[begin : begin + size]), removed=(), moved={})

    def only_moves(self, world: World) -> bool:
        """Whether standing objects of `world` are elsewhere, and nothing else has changed; none of very many boxes."""
        slow = any(thing.link is not None or isinstance(thing.shape, Boxes) for thing in self._moved_of(world))
        return not (self.changed or self.removed or slow)

    def _moved_of(self, world: World) -> Iterator[WorldObject]:
        return (world.objects[name] for name in self.moved)

    def message(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "changed": {name: _written(thing) for name, thing in self.changed.items()},
            "removed": list(self.removed),
            "stale": self.stale,
            "moved": {name: _written_pose(pose) for name, pose in self.moved.items()},
        }

    @classmethod
    def read(cls, message: Mapping[str, Any]) -> Self:
        """From plain values.

        Raises:
            HardwareError: for others than those of `message`; what is not finite is refused as well.
        """
        try:
            changed = {str(name): _read(thing) for name, thing in message.get("changed", {}).items()}
            removed = tuple(map(str, message.get("removed", ())))
            moved = {str(name): _read_pose(pose) for name, pose in message.get("moved", {}).items()}
            return cls(changed, removed, str(message.get("stale", "")), moved)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise HardwareError(f"the guard cannot read a change of the world: {error}") from None


def _written(thing: WorldObject) -> dict[str, Any]:
    return {
        "shape": _written_shape(thing.shape), "pose": _written_pose(thing.pose), "link": thing.link,
        "may_touch": sorted(thing.may_touch), "movable": thing.movable,
    }  # fmt: skip


def _read(thing: Mapping[str, Any]) -> WorldObject:
    link = thing["link"]
    return WorldObject(
        _read_shape(thing["shape"]),
        _read_pose(thing["pose"]),
        None if link is None else str(link),
        frozenset(map(str, thing["may_touch"])),
        bool(thing["movable"]),
    )


def _written_pose(pose: Pose) -> list[float]:
    p, o = pose.position, pose.orientation
    return [p.x, p.y, p.z, o.x, o.y, o.z, o.w]


def _read_pose(values: Sequence[Any]) -> Pose:
    x, y, z, qx, qy, qz, qw = map(float, values)
    # Written so that NaN fails it.
    if not all(abs(each) <= FURTHEST for each in (x, y, z)):
        raise ValueError(f"a position of {x:g}, {y:g}, {z:g} m")
    if not abs(math.hypot(qx, qy, qz, qw) - 1) <= _NEARLY_ONE:
        raise ValueError(f"a quaternion of length {math.hypot(qx, qy, qz, qw):.3g}, must be 1")
    return Pose(Vector3(x, y, z), Quaternion(qx, qy, qz, qw))


def _written_shape(shape: Shape) -> list[Any]:
    match shape:
        case Mesh():
            return ["mesh", _text(shape.vertices, "<f8"), _text(shape.triangles, "<i8"), shape.convex]
        case Voxels():
            kind = _CELLS[0] if np.abs(shape.cells).max() < _FEWER_CELLS else _CELLS[1]
            return ["voxels", shape.size, _text(shape.cells, kind), kind]
        case Boxes():
            return ["boxes", _text(shape.sizes, "<f8"), _text(shape.placements.reshape(-1, 3), "<f8")]
        case _:
            return [_NAMES[type(shape)], *attrs.astuple(shape)]


def _read_shape(values: list[Any]) -> Shape:
    kind, *rest = values
    if kind == "mesh":
        vertices, triangles, convex = rest
        mesh = Mesh(_array(vertices, "<f8"), _array(triangles, "<i8").astype(np.intp), bool(convex))
        if is_large(mesh):
            raise ValueError(f"a mesh of {len(mesh.triangles)} triangles, which is sent as bodies around it")
        return mesh
    if kind == "boxes":
        sizes, placements = rest
        return Boxes(_array(sizes, "<f8"), _array(placements, "<f8").reshape(-1, 4, 3))
    if kind == "voxels":
        size, cells, kind = rest
        return Voxels(float(size), _array(cells, _CELLS[_CELLS.index(kind)]).astype(np.int64))
    simple: Shape = SIMPLE[kind](*rest)
    return simple


def _text(array: np.ndarray[Any, Any], kind: str) -> str:
    return b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode()


def _array(text: str, kind: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(b64decode(text, validate=True), kind).reshape(-1, 3)
