"""A collision-free polyline from a start to one of several goals, and a shorter one.

RRT-Connect (Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000) with a tree
from the start and a forest from all goals.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import accumulate, cycle, pairwise
from typing import ClassVar, Protocol

import attrs
import numpy as np

from ibrobot_core.api import Vector

_RUNS = ((1.6, True), (1.6, True), (0.8, False))
"""For each run, the length of the trees' extensions [rad], and whether blocked ones are dropped whole. That is fast;
in narrow passages, trees also need their free parts."""
_SOME_JOINTS = 0.3
"""Share of extensions that move only some of the joints: these pass narrow passages more easily."""
_ITERATIONS, _MORE = 300, 1.6
"""Iterations of the first run, and the factor from one run to the next. Some random trees are stuck for a minute where
others take a tenth of a second, so that starting again is faster."""
_FIRST_NODES = 256
_DRAWN = 50
"""Samples drawn at a time."""
_FRUITLESS = 15
"""Shortening ends after this many failed attempts in a row."""
_ATTEMPTS = 200
_SHORTER = 1e-3
"""Share by which a shortcut must be faster."""
_STRAIGHT = 0.5
"""Share of straight shortcuts; the others straighten the motion of one joint."""

type Random = np.random.Generator
type Extended = Callable[..., int | None]
"""Grows a tree; see `_extended`."""


class Checks(Protocol):
    """The part of a collision checker that the search uses."""

    @property
    def reach(self) -> Vector:
        """Maximum motion of any point per joint [m/rad], shape (J,)."""

    def first_hit(self, configurations: Vector) -> int:
        """Number of free configurations before the first in collision, of shape (N, J)."""

    def line_free(self, a: Vector, b: Vector, resolution: float) -> bool:
        """Whether the straight line from `a`, which is not checked, to `b` is free, checked every `resolution` [m]."""


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
        number = max(math.ceil(np.abs(b - a) @ self.checks.reach / self.resolution), 1)
        return np.asarray(a + (np.arange(1, number + 1) / number)[:, None] * (b - a))

    straight: ClassVar[bool] = True
    """Whether trees grow along straight lines; otherwise along `curve`."""

    def free(self, a: Vector, b: Vector) -> bool:
        """Whether the line is free; `a` is not checked."""
        return self.checks.line_free(a, b, self.resolution)

    def kept(self, configurations: Vector) -> Vector:
        """Samples, shape (N, J), as the search may use them, shape (at most N, J)."""
        return configurations

    def curve(self, a: Vector, b: Vector, longest: float = math.inf) -> Vector:
        """Points on the way from `a` towards `b`, without `a`, up to the first that is blocked.

        Args:
            a: free, shape (J,).
            b: shape (J,); the last point is exactly `b` if `b` is free, and the way to it.
            longest: greatest length of the line [rad].

        Returns:
            Shape (N, J), with free straight lines between them; N may be 0.
        """
        length = float(np.linalg.norm(b - a))
        end = b if length <= longest else a + (b - a) * (longest / length)
        return end[None] if self.free(a, end) else np.empty((0, len(a)))


@attrs.frozen(eq=False)
class Pace:
    """Limits of the joints, for an estimate of the time that a polyline takes."""

    velocity: Vector
    """[rad/s], shape (J,)."""
    acceleration: Vector
    """[rad/s^2], shape (J,)."""
    blend: float
    """Maximum distance before a corner at which the motion may leave the polyline [rad]."""

    def time(self, points: Vector) -> float:
        """Estimated time from rest to rest along a polyline, shape (N, J), with the widest blends [s]."""
        steps = points[1:] - points[:-1]
        lengths = np.sqrt((steps * steps).sum(axis=1)) + 1e-12
        directions = steps / lengths[:, None]
        across = np.abs(directions)
        # A point may come twice: from beyond a limit, the way in ends at that limit, where the goal may be.
        tops = 1 / np.maximum((across / self.velocity).max(axis=1), 1e-12)
        rates = 1 / np.maximum((across / self.acceleration).max(axis=1), 1e-12)
        if len(steps) == 1:
            return _travel(float(lengths[0]), 0.0, 0.0, float(tops[0]), float(rates[0]))
        turns = (np.abs(directions[1:] - directions[:-1]) / self.acceleration).max(axis=1) + 1e-12
        radii = np.minimum(np.minimum(lengths[:-1], lengths[1:]) / 2, self.blend)
        corners = np.minimum(np.sqrt(2 * radii / turns), np.minimum(tops[:-1], tops[1:]))
        straight = lengths.copy()
        straight[:-1] -= radii
        straight[1:] -= radii
        speeds = [0.0, *corners.tolist(), 0.0]
        ways, rising = straight.tolist(), rates.tolist()
        for i in range(len(ways) - 1, 0, -1):
            speeds[i] = min(speeds[i], math.sqrt(speeds[i + 1] ** 2 + 2 * rising[i] * ways[i]))
        for i in range(1, len(ways)):
            speeds[i] = min(speeds[i], math.sqrt(speeds[i - 1] ** 2 + 2 * rising[i - 1] * ways[i - 1]))
        total = 0.0
        for radius, speed in zip(radii.tolist(), speeds[1:-1], strict=True):
            total += 2 * radius / max(speed, 1e-6)
        for way, before, after, top, rate in zip(ways, speeds[:-1], speeds[1:], tops.tolist(), rising, strict=True):
            total += _travel(way, before, after, top, rate)
        return total


def _travel(way: float, before: float, after: float, top: float, rate: float) -> float:
    """Time to travel a distance between two speeds, below a top speed [s]."""
    peak = min(top, math.sqrt(rate * way + (before * before + after * after) / 2))
    if peak <= 0:
        return 0.0
    changing = (2 * peak * peak - before * before - after * after) / (2 * rate)
    return (2 * peak - before - after) / rate + max(way - changing, 0.0) / peak


class _Tree:
    """Nodes with their parents, from one or several roots."""

    def __init__(self, roots: Vector, weights: Vector) -> None:
        self.size = len(roots)
        self._weights = weights
        self._nodes = np.zeros((max(_FIRST_NODES, 2 * self.size), roots.shape[1]))
        self._nodes[: self.size] = roots
        self._weighted = self._nodes * weights
        self._parents = [-1] * self.size

    def add(self, node: Vector, parent: int) -> int:
        if self.size == len(self._nodes):
            self._nodes, self._weighted = (
                np.concatenate([each, np.empty_like(each)]) for each in (self._nodes, self._weighted)
            )
        self._nodes[self.size] = node
        np.multiply(node, self._weights, out=self._weighted[self.size])
        self._parents.append(parent)
        self.size += 1
        return self.size - 1

    def node(self, index: int) -> Vector:
        node: Vector = self._nodes[index]
        return node

    def distance(self, a: Vector, b: Vector) -> float:
        """Weighted distance, as in `nearest` [rad]."""
        way = (b - a) * self._weights
        return math.sqrt(way @ way)

    def nearest(self, q: Vector) -> int:
        away = self._weighted[: self.size] - q * self._weights
        return int(np.vecdot(away, away).argmin())

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
        rng: source of the samples.
        expired: whether to give up.

    Returns:
        Waypoints with both ends, or None if the search gave up.
    """
    for goal in sorted(goals, key=lambda each: float(np.linalg.norm(each - start))):
        if space.free(start, goal):
            return [start, goal]
        if not space.straight and _reaches(points := space.curve(start, goal), goal):
            return [start, *points]
    iterations = float(_ITERATIONS)
    for longest, whole in cycle(_RUNS):
        if expired():
            break
        extended = _extended_along if not space.straight else _extended if whole else _extended_in_part
        path = _grown(space, start, goals, rng, expired, int(iterations), partial(extended, space, longest))
        if path is not None:
            return path
        iterations *= _MORE
    return None


def _grown(
    space: Space, start: Vector, goals: Sequence[Vector], rng: Random, expired: Callable[[], bool], iterations: int,
    extended: Extended,
) -> list[Vector] | None:  # fmt: skip
    """One run of RRT-Connect."""
    # Weight joints by how far they move the arm.
    weights = np.sqrt(space.checks.reach / space.checks.reach.max())
    here, there = _Tree(start[None], weights), _Tree(np.array(goals), weights)
    forwards = True
    for sample, some, joints in _samples(space, rng, iterations):
        if expired():
            return None
        # Grow the smaller tree.
        if here.size > there.size:
            here, there, forwards = there, here, not forwards
        parent = here.nearest(sample)
        target = np.where(joints, sample, here.node(parent)) if some else sample
        grown = extended(here, parent, target, once=True)
        if grown is None:
            continue
        node = here.node(grown)
        met = extended(there, there.nearest(node), node, once=False)
        if met is not None and np.array_equal(there.node(met), node):
            way = here.way(grown) + there.way(met)[-2::-1]
            return way if forwards else way[::-1]
    return None


def _samples(space: Space, rng: Random, number: int) -> Iterator[tuple[Vector, bool, Vector]]:
    """Random configurations, whether to move only some joints towards each, and which, shape (J,).

    Drawn many at once, which is much faster.
    """
    width = space.upper - space.lower
    for _ in range(0, number, _DRAWN):
        configurations = space.lower + rng.random((_DRAWN, len(width))) * width
        some = (rng.random(_DRAWN) < _SOME_JOINTS).tolist()
        joints = rng.random(configurations.shape) < 0.5
        yield from zip(space.kept(configurations), some, joints, strict=False)


def _extended(space: Space, longest: float, tree: _Tree, parent: int, target: Vector, *, once: bool) -> int | None:
    """Grow a tree from a node towards `target`, by extensions of equal length until one is blocked.

    Most blocked extensions are found at their middle or end, which costs little.

    Returns:
        The last new node; None without any.
    """
    base = tree.node(parent).copy()
    number = max(math.ceil(tree.distance(base, target) / longest), 1)
    last, before = None, base
    for k in range(1, 2 if once else number + 1):
        end = target if k == number else base + (target - base) * (k / number)
        if not space.free(before, end):
            break
        last = parent = tree.add(end, parent)
        before = end
    return last


def _extended_in_part(
    space: Space, longest: float, tree: _Tree, parent: int, target: Vector, *, once: bool
) -> int | None:
    """Grow a tree from a node towards `target`, as far as the line is free; with `once`, by one extension at most.

    Returns:
        The new node; None without any.
    """
    base = tree.node(parent).copy()
    length = tree.distance(base, target)
    end = base + (target - base) * (longest / length) if once and length > longest else target
    line = space.line(base, end)
    free = space.checks.first_hit(line)
    if free == 0:
        return None
    # The last free configuration is close to contact: extensions from a node before it succeed more often.
    if free < len(line):
        free = max(free // 2, 1) if once else free
    return tree.add(line[free - 1] if free < len(line) else end, parent)


def _extended_along(
    space: Space, longest: float, tree: _Tree, parent: int, target: Vector, *, once: bool
) -> int | None:
    """Grow a tree from a node along a curve towards `target`, until it is blocked; as `_extended`."""
    last = None
    for point in space.curve(tree.node(parent).copy(), target, longest if once else math.inf):
        last = parent = tree.add(point, parent)
    return last


def _reaches(points: Vector, end: Vector) -> bool:
    """Whether points of a curve end at `end`."""
    return len(points) > 0 and np.array_equal(points[-1], end)


def length(path: Vector) -> float:
    """Length of a polyline, shape (N, J), in the unit of its points."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def shortened(space: Space, path: Sequence[Vector], rng: Random, pace: Pace) -> list[Vector]:
    """A faster free polyline between the same ends.

    Corners are cut by lines between random points of the path, and between points from which single joints go the
    straight way (partial shortcuts; Geraerts and Overmars, "Creating high-quality paths for motion planning", 2007).
    """
    best = _pruned(space, list(path))
    time, ends = pace.time(np.array(best)), _ends(best)
    fruitless = 0
    for _ in range(_ATTEMPTS):
        if len(best) < 3 or fruitless >= _FRUITLESS:
            break
        (i, a), (j, b) = (_at(best, ends, way) for way in sorted((rng.random(2) * ends[-1]).tolist()))
        if i == j:
            continue
        inner = [] if rng.random() < _STRAIGHT else _with_even_joint(a, best[i + 1 : j + 1], b, rng)
        if not (space.straight or inner or space.free(a, b)) and _reaches(points := space.curve(a, b), b):
            inner = list(points[:-1])
        candidate = _straightened([*best[: i + 1], a, *inner, b, *best[j + 1 :]])
        faster = pace.time(np.array(candidate))
        if faster < time * (1 - _SHORTER) and all(space.free(c, d) for c, d in pairwise([a, *inner, b])):
            best, time, ends, fruitless = candidate, faster, _ends(candidate), 0
        else:
            fruitless += 1
    return _pruned(space, best)


def _ends(path: Sequence[Vector]) -> list[float]:
    """Distance along a path to the end of each segment [rad]."""
    return list(accumulate(float(np.linalg.norm(b - a)) for a, b in pairwise(path)))


def _at(path: Sequence[Vector], ends: Sequence[float], way: float) -> tuple[int, Vector]:
    """The index of the segment and the point at a distance along a path."""
    segment = min(bisect_left(ends, way), len(ends) - 1)
    begin = ends[segment - 1] if segment else 0.0
    share = (way - begin) / max(ends[segment] - begin, 1e-12)
    return segment, path[segment] + share * (path[segment + 1] - path[segment])


def _with_even_joint(a: Vector, inner: Sequence[Vector], b: Vector, rng: Random) -> list[Vector]:
    """Waypoints between `a` and `b` along which one random joint moves evenly, and the others as before."""
    joint = int(rng.integers(len(a)))
    points = np.array([a, *inner, b])
    ways = np.delete(np.abs(np.diff(points, axis=0)), joint, axis=1).sum(axis=1)
    shares = np.cumsum(ways)[:-1] / max(ways.sum(), 1e-12)
    points[1:-1, joint] = a[joint] + shares * (b[joint] - a[joint])
    return list(points[1:-1])


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
        along = math.sqrt((ahead @ ahead) * (behind @ behind))
        if along > 1e-12 and ahead @ behind < along * (1 - 1e-9):
            kept.append(point)
    return [*kept, path[-1]]
