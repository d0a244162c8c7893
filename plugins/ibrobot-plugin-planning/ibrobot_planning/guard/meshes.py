"""Meshes of very many triangles as simpler bodies around them, which control reads and builds between two ticks."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_planning.world.coal_shapes import convex_faces
from ibrobot_planning.world.objects import Boxes, Mesh, World

type _Group = np.ndarray[tuple[int], np.dtype[np.intp]]

MOST_TRIANGLES = 1000
"""Triangles, or vertices, of a mesh that counts as it is."""
_MOST_BOXES = 1024
"""Boxes around a mesh with more of them."""
_MOST_CORNERS = 256
"""Corners of the body around a convex one."""
_FINEST = 64
"""Triangles longer than this share of the mesh are cut, so that no box is around one of them."""
_MOST_CUT = 400_000
"""Triangles from which on none is cut further."""
_THINNEST_M = 2e-4
"""Least thickness of a box [m]."""
_FLATTEST = 1e-9
"""Faces that are smaller than this share of the largest one are rounding."""


def _ways(count: int) -> Vector:
    """Directions that are spread evenly, shape (N, 3)."""
    heights, turns = 1 - (2 * np.arange(count) + 1) / count, np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(turns), radii * np.sin(turns), heights], axis=1)


_WAYS = np.concatenate([_ways(_MOST_CORNERS - 6), np.eye(3), -np.eye(3)])
"""In each of them, the farthest point of a convex mesh counts."""


class Meshes:
    """Replaces the large meshes of worlds, each once."""

    def __init__(self) -> None:
        self._known: dict[Mesh, Mesh | Boxes] = {}

    def simple(self, world: World) -> World:
        """The world with boxes in place of large meshes; the same one without any."""
        large = {
            name: thing.shape
            for name, thing in world.objects.items()
            if isinstance(thing.shape, Mesh) and is_large(thing.shape)
        }
        self._known = {mesh: self._known.get(mesh) or surrounding(mesh) for mesh in large.values()}
        objects = {name: attrs.evolve(world.objects[name], shape=self._known[mesh]) for name, mesh in large.items()}
        return World({**world.objects, **objects}) if large else world


def is_large(mesh: Mesh) -> bool:
    """Whether control would take too long to read a mesh, and to make a shape of it."""
    return max(len(mesh.triangles), len(mesh.vertices)) > MOST_TRIANGLES


def surrounding(mesh: Mesh) -> Mesh | Boxes:
    """Boxes that together contain all triangles of a mesh; of a convex one, a convex body around it."""
    if mesh.convex:
        return _enclosing(mesh.vertices)
    corners = _cut(mesh.vertices[mesh.triangles])
    boxes = [_box(corners[group].reshape(-1, 3)) for group in _groups(corners)]
    return Boxes(np.array([size for size, _ in boxes]), np.array([placement for _, placement in boxes]))


def _enclosing(points: Vector) -> Mesh:
    """A convex body with few corners around points, shape (N, 3) [m]: some of them, moved outwards from the middle."""
    centre = points.mean(axis=0)
    spread, axes = np.linalg.eigh((points - centre).T @ (points - centre))
    # Stretched to be as wide along all directions, so that flat and long bodies are no worse than a ball.
    stretch = axes * np.sqrt(spread)
    ball = np.linalg.solve(stretch, (points - centre).T).T
    farthest = np.unique([int((ball @ way).argmax()) for way in _WAYS])
    corners, faces = convex_faces(ball[farthest])
    middle = corners.mean(axis=0)
    a, b, c = (corners[faces[:, number]] - middle for number in range(3))
    normals = np.cross(b - a, c - a)
    offsets = np.einsum("fc,fc->f", normals, a)
    is_face = np.abs(offsets) > _FLATTEST * np.abs(offsets).max()
    outwards = normals[is_face] / offsets[is_face, None]
    further = max(1.0, *(float(((ball - middle) @ way).max()) for way in outwards))
    return Mesh(centre + (middle + further * (corners - middle)) @ stretch.T, faces, convex=True)


def _cut(corners: Vector) -> Vector:
    """Triangles of shape (M, 3, 3) [m], the long ones cut in halves until none is long."""
    longest = float(np.ptp(corners.reshape(-1, 3), axis=0).max()) / _FINEST
    done, todo, count = list[Vector](), corners, len(corners)
    while len(todo):
        edges = np.linalg.norm(np.roll(todo, -1, axis=1) - todo, axis=2)
        is_long = edges.max(axis=1) > longest
        if count + int(is_long.sum()) > _MOST_CUT:
            is_long[:] = False
        done.append(todo[~is_long])
        # Turned so that the longest edge is the first.
        begin, rows = edges[is_long].argmax(axis=1), np.arange(int(is_long.sum()))
        a, b, c = (todo[is_long][rows, (begin + k) % 3] for k in range(3))
        middle = (a + b) / 2
        todo = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        count += len(rows)
    return np.concatenate(done)


def _groups(corners: Vector) -> Iterator[_Group]:
    """Neighbouring triangles, of shape (M, 3, 3); the largest group is halved until there are as many as allowed."""
    middles = corners.mean(axis=1)

    def entry(group: _Group) -> tuple[float, int, _Group]:
        return -float(np.ptp(middles[group], axis=0).max()), int(group[0]), group

    # The first triangle, which no other group has, decides between equal sizes: arrays have no order.
    queue = [entry(np.arange(len(corners)))]
    while len(queue) < _MOST_BOXES and queue[0][0] < 0:
        group = heapq.heappop(queue)[2]
        low, high = middles[group].min(axis=0), middles[group].max(axis=0)
        axis = int((high - low).argmax())
        lower = middles[group, axis] < (low[axis] + high[axis]) / 2
        if not lower.any():  # rounding leaves no middle
            heapq.heappush(queue, (0.0, int(group[0]), group))
            continue
        for half in (group[lower], group[~lower]):
            heapq.heappush(queue, entry(half))
    for _, _, group in queue:
        yield group


def _box(points: Vector) -> tuple[Vector, Vector]:
    """Size and placement, as of `Boxes`, of a box around points, shape (N, 3), along their main directions."""
    centre = points.mean(axis=0)
    axes = np.linalg.eigh((points - centre).T @ (points - centre))[1].T
    axes[2] *= np.sign(np.linalg.det(axes))
    along = (points - centre) @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    return np.maximum(high - low, _THINNEST_M), np.concatenate([[centre + (low + high) / 2 @ axes], axes])
