"""Distances of an arm's parts from one another and from the world, along motions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio

from ibrobot_core.api import Vector
from ibrobot_planning.guard.parts import Moving, Part, parts
from ibrobot_planning.world.arm import Arm, Pair, sorted_pair
from ibrobot_planning.world.objects import World, WorldObject

type Indices = np.ndarray[tuple[int], np.dtype[np.intp]]

BETWEEN_M = 0.0008
"""How much nearer than its limit a pair may come between two configurations at which it was measured [m]."""
_SLACK_M = 0.0001
"""How much nearer than its limit a pair may be where it was measured, e.g. because of rounding [m]."""
_GIVE_M = 0.00002
"""Distances within this count as equal [m]."""
_NEAR_M = 0.1
"""Pairs whose bounding spheres are nearer are measured when they are made [m]."""
_LOOK, _CONVEX, _CELLS = 8, 1, 8
"""Time that it takes to place the shapes at a configuration, and to measure a pair of convex shapes, or another one."""


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
        margins: links with another `margin` -> their own [m].
        before: the pairs of the world before, whose parts are used again where they are the same.
        pause: called between steps of a millisecond or two, so that another thread may run.
    """

    def __init__(
        self, arm: Arm, world: World, *, margin: float, self_margin: float, pressed: Mapping[Pair, float],
        margins: Mapping[str, float] | None = None, before: Pairs | None = None,
        pause: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        world.check(arm.frames)
        carried = World({name: thing for name, thing in world.objects.items() if thing.link is not None})
        standing = {name: thing for name, thing in world.objects.items() if thing.link is None}
        known = before if before is not None and before.moving.carried == carried else None
        self.moving: Moving = Moving.of(arm, carried) if known is None else known.moving
        of_before = [] if known is None else known.parts
        robot = of_before[0] if of_before else Part(self.moving, {})
        self._pause = pause
        self.parts: list[Part] = [robot]
        for part in parts(self.moving, standing, of_before[1:]):
            self.parts.append(part)
            pause()
        self._data = arm.model.createData()
        self._turning = np.abs(arm.effects).sum(axis=0)
        """Sum of the motions of all joints that move with each joint, at most [rad/rad], shape (J,)."""
        self.names: Sequence[Pair] = [names for part in self.parts for names in part.names]
        sizes = [len(part.names) for part in self.parts]
        begins = np.cumsum([0, *sizes])
        self._slices = [slice(begin, begin + size) for begin, size in zip(begins[:-1].tolist(), sizes, strict=True)]
        self._of = np.repeat(np.arange(len(sizes)), sizes)
        """The part of each pair, shape (P,)."""
        self._number = np.arange(len(self.names)) - begins[self._of]
        """The pair's number in its part, shape (P,)."""
        own = margins or {}
        least: list[float] = []
        for part in self.parts:
            least += [
                -pressed[pair] if (pair := sorted_pair(a, b)) in pressed
                else own.get(a, own.get(b, margin)) if a in standing or b in standing
                else self_margin
                for a, b in part.names
            ]  # fmt: skip
            pause()
        self.margins: Vector = np.array(least, dtype=float)
        """Least distance of each pair [m], shape (P,)."""
        self.limits = self.margins.copy()
        """The same, or less for pairs that were nearer when they were first seen [m], shape (P,)."""
        self.levers: Vector = np.concatenate([part.levers for part in self.parts])
        """Largest motion of each pair per joint [m/rad], shape (P, J)."""
        self._moves = np.concatenate([part.moves for part in self.parts])
        self._radii = np.concatenate([part.radii for part in self.parts])
        self._convex = np.concatenate([part.convex for part in self.parts])
        self._costs = np.where(self._convex, _CONVEX, _CELLS)
        self._known = np.full(len(self.names), -math.inf)
        """The last distance of each pair [m], shape (P,)."""
        self._at = np.zeros_like(self.levers)
        """The configuration of each [rad], shape (P, J)."""
        self._room = np.full(len(self.parts), -math.inf)
        """How much farther apart than their margin all pairs of each part were at `_seen` [m]."""
        self._seen = np.zeros((len(self.parts), len(arm.joint_names)))
        """The configuration of each [rad]."""
        self._longest = np.array([part.levers.max(axis=0, initial=0.0) for part in self.parts])
        """Largest motion of the pairs of each part per joint [m/rad]."""
        self.measured = 0
        """Number of distances measured so far."""
        self.left = 0
        """How much may still be looked at in this tick; without any, what is not proved is blocked."""

    def take_over(self, other: Pairs, q: Vector) -> None:
        """Know what another one knows, while the joints are at `q`, shape (J,).

        Pairs that are new, but whose names were near one another before, may come no nearer than those might: what is
        sent again and again, e.g. a cloud that flickers, does not let the arm come nearer by what is allowed for
        rounding, again and again.
        """
        known = {id(part): old for old, part in enumerate(other.parts)}
        self.measured += other.measured
        for new, (part, at) in enumerate(zip(self.parts, self._slices, strict=True)):
            if (old := known.get(id(part))) is not None:
                was = other._slices[old]
                self._known[at], self._at[at], self.limits[at] = other._known[was], other._at[was], other.limits[was]
                self._room[new], self._seen[new] = other._room[old], other._seen[old]
        is_made = np.array([id(part) not in known for part in self.parts])
        near = self._within_margin(q, np.flatnonzero(is_made[self._of]))
        if not len(near):
            return
        before = other._within_margin(q, np.arange(len(other.names)))
        left: dict[Pair, float] = {}
        for number, room in zip(before.tolist(), (other._known[before] - other.limits[before]).tolist(), strict=True):
            name = other.names[number]
            left[name] = min(left.get(name, math.inf), max(room, -_SLACK_M))
        for number in near.tolist():
            if (room := left.get(self.names[number])) is not None:
                self.limits[number] = min(self.margins[number], self._known[number] - room)

    def _within_margin(self, q: Vector, among: Indices) -> Indices:
        """Those of some pairs that are nearer than their margins while the joints are at `q`, measured there."""
        moved = np.einsum("pj,pj->p", np.abs(q - self._at[among]), self.levers[among])
        among = among[self._known[among] - moved < self.margins[among]]
        return among[self.distances(q, among) < self.margins[among]]

    def let_go(self) -> None:
        """Free what nobody else has of it, in steps; it is not used any more."""
        while self.parts:
            self.parts.pop()
            self._pause()

    def note_moved(self, objects: Mapping[str, WorldObject]) -> None:
        """Have it that objects are elsewhere, as the loop learns by `move`: for `before`."""
        for part in self.parts:
            part.objects.update((name, thing) for name, thing in objects.items() if name in part.objects)

    def move(self, placements: Mapping[str, Any], q: Vector) -> None:
        """Move objects that stand in the base frame, each to a pinocchio.SE3, while the joints are at `q`.

        The limit of a pair that is near moves along: an object that trembles does not let the arm come nearer by
        what is allowed for rounding, again and again.
        """
        self._set(q)
        for number, (part, at) in enumerate(zip(self.parts, self._slices, strict=True)):
            here = {name: placement for name, placement in placements.items() if name in part.objects}
            if not here:
                continue
            pairs = part.of(here) + at.start
            margins, moved = self.margins[pairs], np.abs(q - self._at[pairs])
            near = self._known[pairs] - np.einsum("pj,pj->p", moved, self.levers[pairs]) < margins
            before = self.distances(q, pairs[near])
            part.move(here)
            self._room[number] = -math.inf
            self._known[pairs], self._at[pairs] = part.apart(self._data)[pairs - at.start], q
            limits = margins.copy()
            limits[near] = np.minimum(margins[near], self.limits[pairs[near]] + self.distances(q, pairs[near]) - before)
            self.limits[pairs] = limits

    def estimate(self, q: Vector, other: Pairs | None = None) -> None:
        """Take as distances those of bounding spheres at `q`, shape (J,), and measure those that are near.

        Of parts that another one has, nothing is changed: `take_over` has what is known of them.
        """
        shared = set() if other is None else {id(part) for part in other.parts}
        self._set(q)
        for part, at in zip(self.parts, self._slices, strict=True):
            if id(part) not in shared:
                self._known[at], self._at[at] = part.apart(self._data), q
                near = at.start + np.flatnonzero(self._known[at] < _NEAR_M)
                self.distances(q, near)
                self._pause()

    def unproved(self, least: Vector, most: Vector, strays: Vector) -> Indices:
        """Which pairs may come nearer than their margins while joints are within bounds, each of shape (J,).

        Not their limits: a pair that was nearer once must be measured while it parts, so that its limit rises.

        Args:
            least: lowest positions of the joints.
            most: highest ones.
            strays: how far each joint may be from there.
        """
        far = np.maximum(np.abs(least - self._seen), np.abs(most - self._seen)) + strays
        wide = (far * self._longest).sum(axis=1) >= self._room
        if not wide.any():
            return np.zeros(0, dtype=np.intp)
        among = np.flatnonzero(wide[self._of])
        of, middle = self._of[among], (least + most) / 2
        known, at, levers = self._known[among], self._at[among], self.levers[among]
        room = known - self.margins[among]
        begins = np.flatnonzero(np.diff(of, prepend=-1))
        near = room - np.einsum("pj,pj->p", np.abs(middle - at), levers)
        self._room[of[begins]], self._seen[of[begins]] = np.minimum.reduceat(near, begins), middle
        far = np.maximum(np.abs(least - at), np.abs(most - at)) + strays
        unproved: Indices = among[room < np.einsum("pj,pj->p", far, levers)]
        return unproved

    def still_unproved(self, least: Vector, most: Vector, strays: Vector, among: Indices) -> Indices:
        """Those of some pairs, which have been measured since."""
        at = self._at[among]
        far = np.maximum(np.abs(least - at), np.abs(most - at)) + strays
        bound: Vector = np.einsum("pj,pj->p", far, self.levers[among])
        return among[self._known[among] - bound < self.margins[among]]

    def distances(self, q: Vector, pairs: Indices) -> Vector:
        """Measure the distances of pairs at a configuration, shape (J,) [m]."""
        self._set(q)
        compute = pinocchio.computeDistance
        values = np.array([
            compute(part.geometry, part.results, number).min_distance for part, number in self._placed(pairs)
        ], dtype=float)  # fmt: skip
        self.measured += len(pairs)
        self.left -= _LOOK + int(self._costs[pairs].sum())
        self._known[pairs], self._at[pairs] = values, q
        return values

    def _set(self, q: Vector) -> None:
        """Have the joints at a configuration, shape (J,)."""
        arm = self.moving.arm
        pinocchio.forwardKinematics(arm.model, self._data, arm.native(q))

    def _placed(self, pairs: Indices) -> Iterator[tuple[Part, int]]:
        """The part of each pair, with its shapes placed, and the pair's number in it."""
        last = -1
        for of, number in zip(self._of[pairs].tolist(), self._number[pairs].tolist(), strict=True):
            if of != last:
                self.parts[of].place(self._data)
                last = of
            yield self.parts[of], number

    def required(self, q: Vector, pairs: Indices, strays: Vector) -> Vector:
        """How far pairs must stay apart from now on, if the arm is at `q` [m].

        A pair that is nearer than its limit may get farther, and then not come back; so may one that joints that stray
        could lead nearer than it.

        Args:
            q: joint positions [rad], shape (J,).
            pairs: the pairs, K in number.
            strays: how far each joint may be from `q` [rad], shape (J,).
        """
        now, limits, extra = self.distances(q, pairs), self.limits[pairs], self.levers[pairs] @ strays
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
            path: configurations at the ticks, shape (N, J); between ticks all joints move evenly.
            pairs: the pairs to check.
            required: their least distances [m].
        """
        last = len(path) - 1
        steps = np.diff(path, axis=0)
        turns_back = bool(((steps > 0).any(axis=0) & (steps < 0).any(axis=0)).any())
        # Where the motion ends, since most that is blocked is blocked there; and the next command.
        for at in dict.fromkeys((last, 1)):
            apart = self.distances(path[at], pairs) - required
            if (apart < 0).any():
                return pairs[apart < 0]
            if at == last:  # slow motions need no more, however many pairs are near: so an arm gets out of any crowd
                left = apart + BETWEEN_M < self.levers[pairs] @ np.abs(path - path[last]).max(axis=0)
        todo: list[tuple[float, float, Indices, Vector]] = []
        if left.any():
            todo.append((0.0, float(last), pairs[left], required[left]))
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
            if not within and turns_back:
                inside = path[math.ceil(begin) : math.floor(end) + 1]
                half = np.maximum(half, np.abs(inside - at_middle).max(axis=0, initial=0.0))
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
        normals, rates, turns = self._rates(pairs, nearest=False)
        if evenly:
            along, turning = rates @ half, (turns @ half)[..., None]
        else:
            along, turning = np.abs(rates) @ np.abs(half), turns * half
        # |w x n| for directions n of length 1.
        across = (turning**2).sum(axis=2) - np.einsum("kscj,kc->ksj", turning, normals) ** 2
        turn = np.sqrt(np.maximum(across, 0.0)).sum(axis=2)
        swung = turn[:, 0] * self._radii[pairs, 0] + turn[:, 1] * self._radii[pairs, 1]
        curved = (self._turning @ np.abs(half)) * (self.levers[pairs] @ np.abs(half)) / 2
        approach: Vector = np.where(self._convex[pairs], np.abs(along) + swung + curved, np.inf)
        return approach

    def gradients(self, pairs: Indices) -> Vector:
        """How the distances of pairs change with the joints where they were measured last [m/rad], shape (K, J)."""
        return self._rates(pairs, nearest=True)[1]

    def _rates(self, pairs: Indices, *, nearest: bool) -> tuple[Vector, Vector, Vector]:
        """Motion of pairs with the joints where they were measured last: of points of bodies.

        Args:
            pairs: the pairs, K in number.
            nearest: whether of the nearest points, or else of the centres of bounding spheres.

        Returns:
            The direction from the first body to the second, shape (K, 3); how fast they part [m/rad], shape (K, J); and
            how they turn, shape (K, 2, 3, J).
        """
        arm = self.moving.arm
        pinocchio.computeJointJacobians(arm.model, self._data)
        jacobian = self._data.J
        normals, points = np.empty((len(pairs), 3)), np.empty((len(pairs), 2, 3))
        for row, (part, number) in enumerate(
            zip((self.parts[of] for of in self._of[pairs].tolist()), self._number[pairs].tolist(), strict=True)
        ):
            result = part.results.distanceResults[number]
            normals[row] = result.normal
            if nearest:
                points[row] = result.getNearestPoint1(), result.getNearestPoint2()
            else:
                a, b = part.ends[number].tolist()
                points[row] = part.results.oMg[a].act(part.centres[a]), part.results.oMg[b].act(part.centres[b])
        turns = jacobian[3:] * self._moves[pairs][:, :, None, :]
        # n . (v + w x p) = n . v + (p x n) . w
        arms = np.stack([_cross(points[:, 0], normals), _cross(points[:, 1], normals)], axis=1)
        moving = (normals @ jacobian[:3])[:, None] * self._moves[pairs] + np.einsum("ksc,kscj->ksj", arms, turns)
        rates = moving[:, 1] - moving[:, 0]
        return normals, rates @ arm.effects, turns @ arm.effects


def _cross(a: Vector, b: Vector) -> Vector:
    """Cross products of rows, shape (K, 3); np.cross takes several times as long for a few."""
    return a[:, (1, 2, 0)] * b[:, (2, 0, 1)] - a[:, (2, 0, 1)] * b[:, (1, 2, 0)]


def _between(path: Vector, at: float) -> Vector:
    """A path at a number of ticks, shape (J,)."""
    before = min(int(at), len(path) - 2)
    share = at - before
    configuration: Vector = path[before] * (1.0 - share) + path[before + 1] * share
    return configuration
