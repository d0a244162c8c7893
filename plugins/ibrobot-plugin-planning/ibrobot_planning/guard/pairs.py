"""Distances of an arm's parts from one another and from the world, along motions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import coal
import numpy as np
import pinocchio

from ibrobot_core.api import Vector
from ibrobot_planning.world.arm import Arm, Pair, sorted_pair
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import World

type Indices = np.ndarray[tuple[int], np.dtype[np.intp]]

BETWEEN_M = 0.0008
"""How much nearer than its limit a pair may come between two configurations at which it was measured [m]."""
_SLACK_M = 0.0001
"""How much nearer than its limit a pair may be where it was measured, e.g. because of rounding [m]."""
_GIVE_M = 0.00002
"""Distances within this count as equal [m]."""
_CONVEX = (coal.Halfspace, coal.Box, coal.Sphere, coal.Capsule, coal.Cylinder, coal.ConvexBase)


class Pairs:
    """The pairs of shapes that must stay apart, and what is known about the distance of each.

    A distance that was measured at one configuration bounds it at others: no point of a pair moves relative to the
    other shape by more than the sum of its lever arms times the joints' motions. So most checks are one product of
    matrices, and only pairs for which it does not suffice are measured again.

    Args:
        arm: the arm; J is the number of its joints.
        world: the objects.
        margin: least distance from objects [m].
        self_margin: least distance between links, and between links and what other links carry [m].
        pressed: pairs that may touch -> how deep they may lie in one another [m].
    """

    def __init__(
        self, arm: Arm, world: World, *, margin: float, self_margin: float, pressed: Mapping[Pair, float]
    ) -> None:
        self._checks = Collisions(arm, world, arm.joint_names, padding=margin, self_padding=self_margin)
        self._geometry, self._results = self._checks.geometry, self._checks.results
        self.names: Sequence[Pair] = self._checks.pairs
        standing = {name for name, thing in world.objects.items() if thing.link is None}
        limits = [
            -pressed[pair] if (pair := sorted_pair(a, b)) in pressed else margin if standing & {a, b} else self_margin
            for a, b in self.names
        ]
        self.margins: Vector = np.array(limits, dtype=float)
        """Least distance of each pair [m], shape (P,)."""
        self.limits = self.margins.copy()
        """The same, or less for pairs that were nearer when they were first seen [m], shape (P,)."""
        shapes = self._geometry.geometryObjects
        of_shapes = _levers(arm, shapes)
        self._first = np.array([pair.first for pair in self._geometry.collisionPairs], dtype=np.intp)
        self._second = np.array([pair.second for pair in self._geometry.collisionPairs], dtype=np.intp)
        a, b = of_shapes[self._first], of_shapes[self._second]
        # A joint that moves both does not change their distance.
        both = (a > 0) & (b > 0)
        self._moves = np.stack([np.where(both, 0.0, a > 0), np.where(both, 0.0, b > 0)], axis=1)
        """Whether each joint moves the first and the second shape of each pair, not the other, shape (P, 2, J)."""
        self.levers: Vector = np.where(both, 0.0, a + b)
        """Largest motion of each pair per joint [m/rad], shape (P, J)."""
        self._centres = [shape.geometry.aabb_center if _has_sphere(shape) else np.zeros(3) for shape in shapes]
        """Of bounding spheres, each in the frame of its shape [m]."""
        self._spheres = np.array([shape.geometry.aabb_radius if _has_sphere(shape) else np.inf for shape in shapes])
        """Their radii [m]."""
        radii = np.array(
            [radius if shape.parentJoint else 0.0 for radius, shape in zip(self._spheres, shapes, strict=True)]
        )
        self._radii = np.stack([radii[self._first], radii[self._second]], axis=1)
        """Of the shapes of each pair that move, shape (P, 2) [m]."""
        convex = np.array([isinstance(shape.geometry, _CONVEX) for shape in shapes])
        self._convex = convex[self._first] & convex[self._second]
        numbers: dict[str, list[int]] = {name: [] for name in world.objects}
        for number, pair in enumerate(self.names):
            for name in pair:
                if name in numbers:
                    numbers[name].append(number)
        self._objects = {name: np.array(each, dtype=np.intp) for name, each in numbers.items()}
        """Object -> its pairs."""
        self._known = np.full(len(self.names), -math.inf)
        """The last distance of each pair [m], shape (P,)."""
        self._at = np.zeros_like(self.levers)
        """The configuration of each [rad], shape (P, J)."""
        self._q: Vector = np.zeros(self.levers.shape[1])
        """The configuration at which the shapes are [rad], shape (J,)."""
        self.measured = 0
        """Number of distances measured so far."""
        self.left = 0
        """How many configurations may still be looked at in this tick; without any, what is not proved is blocked."""

    def keep_limits(self, other: Pairs) -> None:
        """Take over the limits of pairs that were nearer than their margin in the world before."""
        near = np.flatnonzero(other.limits < other.margins)
        before: dict[Pair, float] = {}
        for number in near.tolist():
            name = other.names[number]
            before[name] = min(before.get(name, math.inf), float(other.limits[number]))
        for number, name in enumerate(self.names) if before else ():
            self.limits[number] = min(self.limits[number], before.get(name, math.inf))

    def move(self, name: str, placement: Any) -> None:
        """Move an object that stands in the base frame to `placement`, a pinocchio.SE3."""
        pairs, shape = self._objects[name], self._geometry.ngeoms - len(self._objects) + list(self._objects).index(name)
        self._geometry.geometryObjects[shape].placement = placement
        self.limits[pairs] = self.margins[pairs]
        self.estimate(self._q, pairs)

    def estimate(self, q: Vector, pairs: Indices | None = None) -> None:
        """Take as distances of pairs, by default of all, those of their bounding spheres at `q`, shape (J,)."""
        pairs = np.arange(len(self.names)) if pairs is None else pairs
        self._place(q)
        first, second, placed = self._first[pairs], self._second[pairs], self._results.oMg
        centres = np.zeros((len(self._centres), 3))
        for number in np.union1d(first, second).tolist():
            centres[number] = placed[number].act(self._centres[number])
        apart = np.linalg.norm(centres[first] - centres[second], axis=1)
        self._known[pairs], self._at[pairs] = apart - self._spheres[first] - self._spheres[second], q

    def unproved(self, begin: Vector, end: Vector, extra: Vector, among: Indices | slice = slice(None)) -> Indices:
        """Which pairs of `among` may come nearer than their margins between two configurations, each of shape (J,).

        Not their limits: a pair that was nearer once must be measured while it parts, so that its limit rises.

        Args:
            begin: the first.
            end: the last; on the way between them no joint turns back.
            extra: distance beyond the margin that each pair should keep [m], shape (P,).
            among: the pairs.
        """
        at = self._at[among]
        far = np.maximum(np.abs(begin - at), np.abs(end - at))
        bound: Vector = np.einsum("pj,pj->p", far, self.levers[among])
        return np.flatnonzero(self._known[among] - bound < self.margins[among] + extra[among])

    def distances(self, q: Vector, pairs: Indices) -> Vector:
        """Measure the distances of pairs at a configuration, shape (J,) [m]."""
        self._place(q)
        compute, geometry, results = pinocchio.computeDistance, self._geometry, self._results
        values = np.array([compute(geometry, results, pair).min_distance for pair in pairs.tolist()])
        self.measured += len(pairs)
        self.left -= 1
        self._known[pairs], self._at[pairs] = values, q
        return values

    def _place(self, q: Vector) -> None:
        """Have all shapes where they are at a configuration, shape (J,)."""
        checks, self._q = self._checks, q
        native = checks.native(q[None])[0]
        pinocchio.updateGeometryPlacements(checks.arm.model, checks.data, self._geometry, self._results, native)

    def required(self, q: Vector, pairs: Indices, extra: Vector, strays: Vector) -> Vector:
        """How far pairs must stay apart from now on, if the arm is at `q` [m].

        A pair that is nearer than its limit may get farther, and then not come back; so may one that is within `extra`.

        Args:
            q: joint positions [rad], shape (J,).
            pairs: the pairs, K in number.
            extra: distance beyond the limit that each pair should keep [m], shape (P,).
            strays: how far each joint may be from `q`, of which `extra` is made [rad], shape (J,).
        """
        now, limits, extra = self.distances(q, pairs), self.limits[pairs], extra[pairs]
        if extra.max(initial=0.0) > _SLACK_M:
            extra = np.minimum(extra, self._approach(strays, pairs, evenly=False))
        # A pair that something else than a command has brought together, e.g. a new object, may part.
        limits = np.where(now < limits - BETWEEN_M - 2 * _SLACK_M, now - _GIVE_M, limits)
        limits = np.maximum(limits, np.minimum(self.margins[pairs], now - _GIVE_M))
        self.limits[pairs] = limits
        least = np.maximum(limits - _SLACK_M, np.minimum(limits + extra, now - _GIVE_M))
        return np.minimum(least, now)

    def first_blocked(self, path: Vector, pairs: Indices, required: Vector) -> Indices:
        """The pairs that come nearer than required at one configuration of a path; none if all of it is clear.

        Args:
            path: configurations at the ticks, shape (N, J); no joint turns back, and between ticks all move evenly.
            pairs: the pairs to check.
            required: their least distances [m].
        """
        last = len(path) - 1
        for at in (last, 1):  # where the motion ends, since most that is blocked is blocked there; and the next command
            near = self.distances(path[at], pairs) < required
            if near.any():
                return pairs[near]
        todo = [(0.0, float(last), pairs, required)]
        while todo:
            begin, end, among, needed = todo.pop()
            if self.left <= 0:
                return among
            middle = (begin + end) / 2
            within = math.ceil(end) - math.floor(begin) <= 1
            if not within:
                middle = float(round(middle))
            at_middle, at_end = _between(path, middle), _between(path, end)
            half = np.maximum(np.abs(_between(path, begin) - at_middle), np.abs(at_end - at_middle))
            bound = self.levers[among] @ half
            apart = self.distances(at_middle, among) - needed
            if (apart < 0).any():
                return among[apart < 0]
            left = apart + BETWEEN_M < bound
            if within and left.any():
                left[left] = apart[left] + BETWEEN_M < self._approach(at_end - at_middle, among[left])
            if left.any():
                among, needed = among[left], needed[left]
                todo += [(middle, end, among, needed), (begin, middle, among, needed)]
        return pairs[:0]

    def _approach(self, half: Vector, pairs: Indices, *, evenly: bool = True) -> Vector:
        """How much nearer pairs come at most while all joints move by up to `half` forth or back [m], shape (K,).

        From where they were measured last. A convex pair is at least as far apart as in the direction in which it was
        then; in this direction, each point moves as its bounding sphere does, up to the second order.

        Args:
            half: the motion of each joint [rad], shape (J,).
            pairs: the pairs, K in number.
            evenly: whether they move together, or else each by itself.
        """
        normals, rates, turns = self._rates(pairs, self._centres)
        if evenly:
            along, turning = rates @ half, (turns @ half)[..., None]
        else:
            along, turning = np.abs(rates) @ np.abs(half), turns * half
        # |w x n| for directions n of length 1.
        across = (turning**2).sum(axis=2) - np.einsum("kscj,kc->ksj", turning, normals) ** 2
        turn = np.sqrt(np.maximum(across, 0.0)).sum(axis=2)
        swung = turn[:, 0] * self._radii[pairs, 0] + turn[:, 1] * self._radii[pairs, 1]
        curved = np.abs(half).sum() * (self.levers[pairs] @ np.abs(half)) / 2
        approach: Vector = np.where(self._convex[pairs], np.abs(along) + swung + curved, np.inf)
        return approach

    def gradients(self, pairs: Indices) -> Vector:
        """How the distances of pairs change with the joints where they were measured last [m/rad], shape (K, J)."""
        return self._rates(pairs, None)[1]

    def _rates(self, pairs: Indices, centres: Sequence[Vector] | None) -> tuple[Vector, Vector, Vector]:
        """Motion of pairs with the joints where they were measured last: of points of bodies, by default the nearest.

        Returns:
            The direction from the first body to the second, shape (K, 3); how fast they part [m/rad], shape (K, J); and
            how they turn, shape (K, 2, 3, J).
        """
        checks, results = self._checks, self._results
        pinocchio.computeJointJacobians(checks.arm.model, checks.data)
        jacobian = checks.data.J[:, checks.arm.columns]
        nearest = [results.distanceResults[pair] for pair in pairs.tolist()]
        normals = np.array([each.normal for each in nearest])
        if centres is None:
            ends = [(each.getNearestPoint1(), each.getNearestPoint2()) for each in nearest]
        else:
            numbers = zip(self._first[pairs].tolist(), self._second[pairs].tolist(), strict=True)
            ends = [(results.oMg[a].act(centres[a]), results.oMg[b].act(centres[b])) for a, b in numbers]
        points = np.array(ends)  # (K, 2, 3)
        turns = jacobian[3:] * self._moves[pairs][:, :, None, :]
        # n . (v + w x p) = n . v + (p x n) . w
        arms = np.stack([_cross(points[:, 0], normals), _cross(points[:, 1], normals)], axis=1)
        parts = (normals @ jacobian[:3])[:, None] * self._moves[pairs] + np.einsum("ksc,kscj->ksj", arms, turns)
        rates = parts[:, 1] - parts[:, 0]
        return normals, rates, turns


def _cross(a: Vector, b: Vector) -> Vector:
    """Cross products of rows, shape (K, 3); np.cross takes several times as long for a few."""
    return a[:, (1, 2, 0)] * b[:, (2, 0, 1)] - a[:, (2, 0, 1)] * b[:, (1, 2, 0)]


def _between(path: Vector, at: float) -> Vector:
    """A path at a number of ticks, shape (J,)."""
    before = min(int(at), len(path) - 2)
    share = at - before
    configuration: Vector = path[before] * (1.0 - share) + path[before + 1] * share
    return configuration


def _has_sphere(shape: Any) -> bool:
    """Whether a bounding sphere of a shape is known; it computes it."""
    shape.geometry.computeLocalAABB()
    return math.isfinite(shape.geometry.aabb_radius)


def _levers(arm: Arm, shapes: Sequence[Any]) -> Vector:
    """Largest distance of any point of each shape from each joint's axis [m]; 1 for slides, 0 if it moves it not.

    Shape (S, J). Upper bounds for all configurations, from bounding spheres on a stretched-out arm.
    """
    model = arm.model
    columns = {int(number): column for column, number in enumerate(arm.numbers)}
    travel = np.where(arm.slides, np.maximum(np.abs(arm.lower), np.abs(arm.upper)), 0.0)
    levers = np.zeros((len(shapes), len(arm.joint_names)))
    for row, shape in zip(levers, shapes, strict=True):
        joint = int(shape.parentJoint)
        if joint == 0:
            continue
        shape.geometry.computeLocalAABB()
        centre = shape.placement.act(shape.geometry.aabb_center)
        away = float(np.linalg.norm(centre) + shape.geometry.aabb_radius)
        while joint:
            column = columns[joint]
            row[column] = 1.0 if arm.slides[column] else away
            away += travel[column] + float(np.linalg.norm(model.jointPlacements[joint].translation))
            joint = int(model.parents[joint])
    return levers
