"""A collision-free polyline from a start to one of several goals, and a shorter one.

RRT-Connect (Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000) with a tree
from the start and a forest from all goals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Protocol

import attrs
import numpy as np

from ibrobot_core.api import Vector

_LONGEST = 0.8
"""Length of an extension of the trees [rad]."""
_ITERATIONS, _MORE = 300, 1.6
"""Iterations of the first run, and how many times as many each further one has. Some random trees run into dead ends
for a minute where others take a tenth of a second, so that starting again is the faster way."""
_FIRST_NODES = 256
_FRUITLESS = 10
"""Attempts to shorten a path, one after the other, that end the shortening."""
_ATTEMPTS = 200
_SHORTER = 1e-3
"""Share by which a shortcut must be shorter to be taken."""

type Random = np.random.Generator


class Checks(Protocol):
    """The part of a collision checker that the search uses."""

    @property
    def reach(self) -> Vector:
        """Maximum motion of any point per joint [m/rad], shape (J,)."""

    def first_hit(self, configurations: Vector) -> int:
        """Number of free configurations before the first in collision, of shape (N, J)."""


@attrs.frozen(eq=False)
class Space:
    """The search space: limits and checks."""

    checks: Checks
    lower: Vector
    """[rad], shape (J,)."""
    upper: Vector
    """[rad], shape (J,)."""
    resolution: float
    """Maximum motion of any point of the arm between two checks on a line [m]."""

    def line(self, a: Vector, b: Vector) -> Vector:
        """Configurations to check between `a` and `b`, shape (N, J): without `a`, with `b`."""
        number = max(int(np.ceil(np.abs(b - a) @ self.checks.reach / self.resolution)), 1)
        return np.asarray(a + (np.arange(1, number + 1) / number)[:, None] * (b - a))

    def free(self, a: Vector, b: Vector) -> bool:
        """Whether the line is free; `a` is not checked."""
        line = self.line(a, b)
        # From coarse to fine, which mostly finds obstacles early.
        spread = line[_spread(len(line))]
        return self.checks.first_hit(spread) == len(line)


_SPREADS: dict[int, np.ndarray[tuple[int], np.dtype[np.intp]]] = {}


def _spread(number: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Indices 0 to number - 1, each far from those before it (van der Corput)."""
    if number not in _SPREADS:
        bits = max(number - 1, 1).bit_length()
        codes = np.arange(1 << bits)
        reversed_bits = sum(((codes >> i) & 1) << (bits - 1 - i) for i in range(bits))
        _SPREADS[number] = np.asarray(reversed_bits)[np.asarray(reversed_bits) < number]
    return _SPREADS[number]


class _Tree:
    """Nodes with their parents, from one or several roots."""

    def __init__(self, roots: Vector) -> None:
        self.size = len(roots)
        self._nodes = np.empty((max(_FIRST_NODES, 2 * self.size), roots.shape[1]))
        self._nodes[: self.size] = roots
        self._parents = [-1] * self.size

    def add(self, node: Vector, parent: int) -> int:
        if self.size == len(self._nodes):
            self._nodes = np.concatenate([self._nodes, np.empty_like(self._nodes)])
        self._nodes[self.size] = node
        self._parents.append(parent)
        self.size += 1
        return self.size - 1

    def node(self, index: int) -> Vector:
        return np.asarray(self._nodes[index])

    def nearest(self, q: Vector) -> int:
        away = self._nodes[: self.size] - q
        return int(np.einsum("ij,ij->i", away, away).argmin())

    def way(self, index: int) -> list[Vector]:
        """The path from a root to a node."""
        nodes = []
        while index >= 0:
            nodes.append(self._nodes[index].copy())
            index = self._parents[index]
        return nodes[::-1]


def connect(
    space: Space, start: Vector, goals: Sequence[Vector], rng: Random, expired: Callable[[], bool]
) -> list[Vector] | None:
    """A free polyline from `start` to one of the goals, all of which are free.

    Args:
        space: where to search.
        start: shape (J,).
        goals: each of shape (J,); at least one.
        rng: samples come from it.
        expired: whether to give up.

    Returns:
        Waypoints with both ends, or None where the search gave up.
    """
    for goal in sorted(goals, key=lambda each: float(np.linalg.norm(each - start))):
        if space.free(start, goal):
            return [start, goal]
    iterations = float(_ITERATIONS)
    while not expired():
        path = _grown(space, start, goals, rng, expired, int(iterations))
        if path is not None:
            return path
        iterations *= _MORE
    return None


def _grown(
    space: Space, start: Vector, goals: Sequence[Vector], rng: Random, expired: Callable[[], bool], iterations: int
) -> list[Vector] | None:
    """One run of RRT-Connect."""
    here, there = _Tree(start[None]), _Tree(np.array(goals))
    forwards = True
    for _ in range(iterations):
        if expired():
            return None
        # The smaller tree grows, so that both grow equally.
        if here.size > there.size:
            here, there, forwards = there, here, not forwards
        sample = rng.uniform(space.lower, space.upper)
        grown = _extend(space, here, sample, once=True)
        if grown is None:
            continue
        node = here.node(grown)
        met = _extend(space, there, node, once=False)
        if met is not None and np.array_equal(there.node(met), node):
            way = here.way(grown) + there.way(met)[-2::-1]
            return way if forwards else way[::-1]
    return None


def _extend(space: Space, tree: _Tree, target: Vector, *, once: bool) -> int | None:
    """Grow a tree towards `target`, as far as the line is free; with `once`, by one extension at most.

    Returns:
        The last node of it, or None where there was none.
    """
    parent = tree.nearest(target)
    base = tree.node(parent).copy()
    length = float(np.linalg.norm(target - base))
    end = base + (target - base) * (_LONGEST / length) if once and length > _LONGEST else target
    line = space.line(base, end)
    free = space.checks.first_hit(line)
    if free == 0:
        return None
    # The last free configuration is close to contact: a node some way before it can be extended more often.
    if free < len(line):
        free = max(free // 2, 1) if once else free
    return tree.add(line[free - 1] if free < len(line) else end, parent)


def length(path: Sequence[Vector]) -> float:
    """Length of a polyline [rad]."""
    return float(np.linalg.norm(np.diff(np.asarray(path), axis=0), axis=1).sum())


def shortened(space: Space, path: Sequence[Vector], rng: Random) -> list[Vector]:
    """A shorter free polyline between the same ends.

    Corners are cut by lines between random points of the path, and between points from which single joints go the
    straight way (partial shortcuts; Geraerts and Overmars, "Creating high-quality paths for motion planning", 2007).
    """
    best = _pruned(space, list(path))
    fruitless = 0
    for _ in range(_ATTEMPTS):
        if len(best) < 3 or fruitless >= _FRUITLESS:
            break
        candidate = _cut(best, rng) if rng.random() < 0.6 else _cut_joint(best, rng)
        first = next((i for i, (a, b) in enumerate(zip(best, candidate, strict=False)) if a is not b), 0)
        if length(candidate) < length(best) * (1 - _SHORTER) and _changed_free(space, best, candidate, first):
            best, fruitless = _straightened(candidate), 0
        else:
            fruitless += 1
    return _pruned(space, best)


def _changed_free(space: Space, before: Sequence[Vector], after: Sequence[Vector], first: int) -> bool:
    """Whether the segments of a polyline that differ from another are free."""
    known = {(id(a), id(b)) for a, b in pairwise(before)}
    segments = zip(after[max(first - 1, 0) :], after[max(first, 1) :], strict=False)
    return all(space.free(a, b) for a, b in segments if (id(a), id(b)) not in known)


def _at(path: Sequence[Vector], share: float) -> tuple[int, Vector]:
    """The segment and the point at a share of a path's length."""
    lengths = np.linalg.norm(np.diff(np.asarray(path), axis=0), axis=1)
    ends = np.cumsum(lengths)
    way = share * ends[-1]
    segment = min(int(np.searchsorted(ends, way)), len(lengths) - 1)
    rest = (way - ends[segment] + lengths[segment]) / max(lengths[segment], 1e-12)
    return segment, path[segment] + rest * (path[segment + 1] - path[segment])


def _cut(path: list[Vector], rng: Random) -> list[Vector]:
    """A straight line between two random points."""
    (i, a), (j, b) = (_at(path, share) for share in sorted(rng.random(2)))
    return [*path[: i + 1], a, b, *path[j + 1 :]]


def _cut_joint(path: list[Vector], rng: Random) -> list[Vector]:
    """One joint moves linearly between two random points, the others as before."""
    (i, a), (j, b) = (_at(path, share) for share in sorted(rng.random(2)))
    joint = int(rng.integers(len(a)))
    inner = [point.copy() for point in path[i + 1 : j + 1]]
    points = np.array([a, *inner, b])
    ways = np.delete(np.abs(np.diff(points, axis=0)), joint, axis=1).sum(axis=1)
    if not inner or ways.sum() < 1e-9:
        return path
    shares = np.cumsum(ways)[:-1] / ways.sum()
    for point, share in zip(inner, shares.tolist(), strict=True):
        point[joint] = a[joint] + share * (b[joint] - a[joint])
    return [*path[: i + 1], a, *inner, b, *path[j + 1 :]]


def _pruned(space: Space, path: list[Vector]) -> list[Vector]:
    """The polyline without waypoints that a straight line can bypass."""
    i = 0
    while i + 2 < len(path):
        if space.free(path[i], path[i + 2]):
            path = [*path[: i + 1], *path[i + 2 :]]
            i = max(i - 1, 0)
        else:
            i += 1
    return path


def _straightened(path: list[Vector]) -> list[Vector]:
    """The polyline without waypoints that repeat or lie on the line between their neighbours."""
    kept = [path[0]]
    for point, after in pairwise(path[1:]):
        ahead, behind = after - point, point - kept[-1]
        along = np.linalg.norm(ahead) * np.linalg.norm(behind)
        if along > 1e-12 and ahead @ behind < along * (1 - 1e-9):
            kept.append(point)
    return [*kept, path[-1]]
