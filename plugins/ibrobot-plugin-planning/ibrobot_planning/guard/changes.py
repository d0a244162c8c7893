"""Changes of the world as messages between processes: plain values, arrays as text."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping
from typing import Any, Self

import attrs
import numpy as np

from ibrobot_core.api import HardwareError, Pose, Quaternion, Vector3
from ibrobot_planning.world.objects import SIMPLE, Mesh, Shape, Voxels, World, WorldObject

_NAMES: Mapping[type[Any], str] = {kind: name for name, kind in SIMPLE.items()}
_CELLS, _FEWER_CELLS = ("<i2", "<i8"), 2**15
"""Types of the indices of cells; the first suffices below a limit, and control reads it in a quarter of the time."""
_FARTHEST_M = 1000.0
"""Positions farther away are mistakes, and the distances to them are not computed well."""


@attrs.frozen(eq=False)
class WorldChange:
    """Objects that are new or other than before, those that are gone, and what is too old to rely on."""

    changed: Mapping[str, WorldObject]
    removed: tuple[str, ...] = ()
    stale: str = ""
    """Why the world is not known well enough; empty if it is."""

    @classmethod
    def between(cls, before: World, after: World, stale: str = "") -> Self:
        """What makes one world of another."""
        old = before.objects
        changed = {name: thing for name, thing in after.objects.items() if old.get(name) != thing}
        return cls(changed, tuple(name for name in old if name not in after.objects), stale)

    def apply(self, world: World) -> World:
        """The world after the change; the same object if it stays as it is."""
        if not self.changed and not self.removed:
            return world
        kept = {name: thing for name, thing in world.objects.items() if name not in self.removed}
        return World({**kept, **self.changed})

    def parts(self, size: int) -> Iterator[Self]:
        """The same as several changes of at most so many objects each."""
        items = list(self.changed.items())
        yield attrs.evolve(self, changed=dict(items[:size]))
        for begin in range(size, len(items), size):
            yield attrs.evolve(self, changed=dict(items[begin : begin + size]), removed=())

    def only_moved(self, world: World) -> tuple[str, ...] | None:
        """The standing objects that are only elsewhere than in `world`; None if anything else has changed."""
        for name, thing in self.changed.items():
            known = world.objects.get(name)
            if known is None or thing.link is not None or attrs.evolve(known, pose=thing.pose) != thing:
                return None
        return None if self.removed else tuple(self.changed)

    def message(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "changed": {name: _written(thing) for name, thing in self.changed.items()},
            "removed": list(self.removed),
            "stale": self.stale,
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
            return cls(changed, removed, str(message.get("stale", "")))
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise HardwareError(f"the guard cannot read a change of the world: {error}") from None


def _written(thing: WorldObject) -> dict[str, Any]:
    p, o = thing.pose.position, thing.pose.orientation
    return {
        "shape": _written_shape(thing.shape), "pose": [p.x, p.y, p.z, o.x, o.y, o.z, o.w], "link": thing.link,
        "may_touch": sorted(thing.may_touch), "movable": thing.movable,
    }  # fmt: skip


def _read(thing: Mapping[str, Any]) -> WorldObject:
    x, y, z, qx, qy, qz, qw = map(float, thing["pose"])
    if max(abs(x), abs(y), abs(z)) > _FARTHEST_M:
        raise ValueError(f"a position of {x:g}, {y:g}, {z:g} m")
    link = thing["link"]
    return WorldObject(
        _read_shape(thing["shape"]),
        Pose(Vector3(x, y, z), Quaternion(qx, qy, qz, qw)),
        None if link is None else str(link),
        frozenset(map(str, thing["may_touch"])),
        bool(thing["movable"]),
    )


def _written_shape(shape: Shape) -> list[Any]:
    match shape:
        case Mesh():
            return ["mesh", _text(shape.vertices, "<f8"), _text(shape.triangles, "<i8"), shape.convex]
        case Voxels():
            kind = _CELLS[0] if np.abs(shape.cells).max() < _FEWER_CELLS else _CELLS[1]
            return ["voxels", shape.size, _text(shape.cells, kind), kind]
        case _:
            return [_NAMES[type(shape)], *attrs.astuple(shape)]


def _read_shape(values: list[Any]) -> Shape:
    kind, *rest = values
    if kind == "mesh":
        vertices, triangles, convex = rest
        return Mesh(_array(vertices, "<f8"), _array(triangles, "<i8").astype(np.intp), bool(convex))
    if kind == "voxels":
        size, cells, kind = rest
        return Voxels(float(size), _array(cells, _CELLS[_CELLS.index(kind)]).astype(np.int64))
    simple: Shape = SIMPLE[kind](*rest)
    return simple


def _text(array: np.ndarray[Any, Any], kind: str) -> str:
    return b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode()


def _array(text: str, kind: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(b64decode(text, validate=True), kind).reshape(-1, 3)
