"""Path constraints as functions of the joints: by how much each is exceeded, and the nearest joints that keep all.

All depend on the pose of the tip alone. Each is a number that must not be positive: an angle beyond its tolerance
[rad], or a distance outside a region [m]. Projection is the damped Newton method of Berenson et al., "Manipulation
planning on constraint manifolds", 2009.
"""

from __future__ import annotations

import math

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.model import KinematicModel, TipPose
from ibrobot_kinematics.path_constraints import AXES, PathConstraints, direction
from ibrobot_kinematics.rotations import cross
from ibrobot_kinematics.target import Target

_UP = np.array([0.0, 0.0, 1.0])
_INSIDE = 0.1
"""Share of a tolerance that projections stay away from it."""
_INSIDE_RAD, _INSIDE_M = 0.03, 0.005
"""The same, at most."""
_ITERATIONS = 25
_LONGEST_STEP = 0.3
"""Greatest change of a joint in an iteration [rad or m]."""
_DAMPING = 1e-9
_LEVER_M = 0.1
"""Length that corresponds to a turn of one radian [m]."""
_MET_M, _MET_RAD = 1e-6, 1e-6
"""Errors within which a projection meets a target."""
_TINY = 1e-12

type Flags = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


@attrs.frozen(eq=False)
class _Kind:
    """One number that must not be positive."""

    name: str
    """Key of `PathConstraints`."""
    largest: float
    """Tolerance [rad], or 0 for a side of a region [m]."""
    inside: float
    """How far projections stay away from the tolerance [rad or m]."""


class ToolConstraints:
    """The constraints of one motion.

    Args:
        given: the constraints.
        model: the arm.
        start: joint positions at the start [rad or m], shape (J,): they decide `upright_axis` if it is not given.

    Attributes:
        given: the constraints, with the `upright_axis` of the start.
        number: K, the number of constraints; each side of a region counts.
        insides: how far from their bounds projections and servo stay, shape (K,) [rad or m].
    """

    def __init__(self, given: PathConstraints, model: KinematicModel, start: Vector) -> None:
        self.model = model
        if given.upright is not None and given.upright_axis is None:
            ups = model.forward(start).rotation[2]  # the vertical in the frame of the tip
            nearest = max(AXES, key=lambda name: float(np.dot(direction(name), ups)))
            given = attrs.evolve(given, upright_axis=nearest)
        self.given = given
        kinds = []
        if given.upright is not None:
            kinds.append(_Kind("upright", given.upright, min(_INSIDE * given.upright, _INSIDE_RAD)))
        if given.region is not None:
            self._low, self._high = np.array(given.region[:3]), np.array(given.region[3:])
            insides = np.minimum(_INSIDE * (self._high - self._low), _INSIDE_M).tolist()
            kinds += [_Kind("region", 0.0, inside) for inside in (*insides, *insides)]
        if given.view is not None:
            kinds.append(_Kind("view", given.view_angle, min(_INSIDE * given.view_angle, _INSIDE_RAD)))
            self._camera = np.array(given.view_from)
        self._kinds = tuple(kinds)
        self.number = len(kinds)
        self.insides = np.array([kind.inside for kind in kinds])
        self._weights = np.array([1 / _LEVER_M if kind.name == "region" else 1.0 for kind in kinds])

    def excess(self, q: Vector) -> Vector:
        """By how much joints, shape (…, J), exceed each constraint [rad or m], negative inside, shape (…, K)."""
        return self._excess(self.model.forward(q))

    def kept(self, q: Vector, allowed: float = 0.0) -> Flags:
        """Whether configurations, shape (…, J), keep all constraints, up to an excess [rad or m]; shape (…)."""
        return np.asarray((self.excess(q) <= allowed).all(axis=-1))

    def first_broken(self, path: Vector, allowed: float = 0.0) -> int:
        """Number of configurations of a path, shape (N, J), before the first that breaks a constraint."""
        broken = ~self.kept(path, allowed)
        return int(broken.argmax()) if broken.any() else len(path)

    def excess_and_rates(self, q: Vector) -> tuple[Vector, Vector]:
        """`excess(q)`, and its derivatives by the joints of the chain, shape (…, K, n)."""
        tip, linear, angular = self.model.twists(q)
        return self._excess(tip), self._rates(tip, linear, angular)

    def broken(self, q: Vector, allowed: float = 0.0) -> str:
        """In words, the constraint that a configuration, shape (J,), exceeds most; empty if it keeps all."""
        excess = self.excess(q)
        worst = int((excess * self._weights).argmax())
        if not excess[worst] > allowed:
            return ""
        return self._sentence(worst, float(excess[worst]), self.model.forward(q))

    def moved_by(self, q: Vector, velocity: Vector) -> str:
        """The joint whose velocity, all of shape (J,), drives the most exceeded constraint."""
        excess, rates = self.excess_and_rates(q)
        moving = self.model.moving
        worst = int((excess * self._weights).argmax())
        return self.model.joint_names[int(moving[int(np.abs(rates[worst] * velocity[moving]).argmax())])]

    def projected(self, q: Vector, target: Target | None = None) -> tuple[Vector, Flags]:
        """Joints near `q` that keep all constraints, and that have the tip at a target, if there is one.

        Joints that keep them already, and meet the target, are returned unchanged.

        Args:
            q: joint positions within the limits, shape (N, J).
            target: a position of the tip, alone or with an axis.

        Returns:
            The joints, shape (N, J), within the limits, and which of them succeeded, shape (N,).
        """
        model, q = self.model, q.copy()
        moving = model.moving
        lower, upper = model.lower[moving], model.upper[moving]
        done = np.zeros(len(q), dtype=bool)
        for iteration in range(_ITERATIONS + 1):
            todo = np.flatnonzero(~done)
            tip, linear, angular = model.twists(q[todo])
            excess, rates = self._excess(tip), self._rates(tip, linear, angular)
            ready = (excess <= 0).all(axis=1)
            # Newton's method meets a tolerance from inside, and not from outside.
            excess = np.where(excess + self.insides > 0, excess + self.insides, 0.0)
            errors, moves = [self._weights * excess], [self._weights[:, None] * rates * (excess > 0)[..., None]]
            if target is not None:
                away, turn = self._missed(tip, target)
                ready &= (np.abs(away).max(axis=1) <= _MET_M) & (np.abs(turn).max(axis=1, initial=0.0) <= _MET_RAD)
                if target.axis is not None:
                    ready &= tip.rotation[..., 2] @ target.axis > 0  # not the opposite axis
                errors += [away / _LEVER_M, turn]
                moves += [linear.mT / _LEVER_M, self._turning(tip, angular, target)]
            done[todo[ready]] = True
            if iteration == _ITERATIONS or done.all():
                break
            error, rows = np.concatenate(errors, axis=1)[~ready], np.concatenate(moves, axis=1)[~ready]
            here = q[todo[~ready]][:, moving]
            step = _least_step(rows, error, lower - here, upper - here)
            long = np.abs(step).max(axis=1, keepdims=True)
            step *= np.minimum(1.0, _LONGEST_STEP / np.maximum(long, _TINY))
            whole = q[todo[~ready]]
            whole[:, moving] = np.clip(here + step, lower, upper)
            q[todo[~ready]] = whole
        return q, done

    def _excess(self, tip: TipPose) -> Vector:
        given, columns = self.given, []
        if given.upright is not None:
            columns.append(_angle(self._upright(tip), _UP)[..., None] - given.upright)
        if given.region is not None:
            columns += [tip.position - self._high, self._low - tip.position]
        if given.view is not None:
            axis, way, _ = self._view(tip)
            columns.append(_angle(axis, way)[..., None] - given.view_angle)
        return np.concatenate(columns, axis=-1)

    def _rates(self, tip: TipPose, linear: Vector, angular: Vector) -> Vector:
        """Derivatives of the excess by the chain's joints, shape (…, K, n), from their twists, shape (…, n, 3)."""
        given, rows = self.given, []
        if given.upright is not None:
            normal = _normal(self._upright(tip), _UP)
            rows.append(-(angular @ normal[..., None]).mT)
        if given.region is not None:
            rows += [linear.mT, -linear.mT]
        if given.view is not None:
            axis, way, distance = self._view(tip)
            normal = _normal(axis, way)
            camera = linear + cross(angular, (tip.rotation @ self._camera)[..., None, :])
            # The part of the axis that is perpendicular to the way: the camera's motion turns the way towards it.
            across = cross(normal, way)
            turned = (camera @ across[..., None]).mT / distance[..., None, None]
            rows.append(-(angular @ normal[..., None]).mT - turned)
        return np.concatenate(rows, axis=-2)

    def _upright(self, tip: TipPose) -> Vector:
        assert self.given.upright_axis is not None
        return np.asarray(tip.rotation @ np.array(direction(self.given.upright_axis)))

    def _view(self, tip: TipPose) -> tuple[Vector, Vector, Vector]:
        """The camera's axis and the direction to the point, unit vectors, shape (…, 3), and its distance [m]."""
        axis = tip.rotation @ np.array(direction(self.given.view_axis))
        way = np.array(self.given.view) - (tip.position + tip.rotation @ self._camera)
        distance = np.maximum(np.linalg.norm(way, axis=-1), _TINY)
        return axis, way / distance[..., None], distance

    def _missed(self, tip: TipPose, target: Target) -> tuple[Vector, Vector]:
        """How far a tip is from a target: [m], shape (N, 3), and the turn back as a vector [rad], shape (N, 0 or 3)."""
        away = tip.position - target.position
        if target.axis is not None:
            return away, cross(np.broadcast_to(target.axis, away.shape), tip.rotation[..., 2])
        return away, np.zeros((len(away), 0))

    def _turning(self, tip: TipPose, angular: Vector, target: Target) -> Vector:
        """Derivatives of the turn of `_missed` by the chain's joints, shape (N, 0 or 3, n)."""
        if target.axis is None:
            return np.zeros((len(angular), 0, angular.shape[1]))
        moved = cross(angular, tip.rotation[..., None, :, 2])
        return cross(np.broadcast_to(target.axis, moved.shape), moved).mT

    def _sentence(self, worst: int, excess: float, tip: TipPose) -> str:
        kind, given = self._kinds[worst], self.given
        if kind.name == "region":
            first = next(i for i, each in enumerate(self._kinds) if each.name == "region")
            side = worst - first
            axis, bound = "xyz"[side % 3], (*self._high, *self._low)[side]
            which = "below its upper" if side < 3 else "above its lower"
            at = tip.position[side % 3]
            return f"region: the tool is at {axis} = {at:.4f} m, must be {which} {axis}, {bound:.4f} m"
        off, most = math.degrees(excess + kind.largest), math.degrees(kind.largest)
        if kind.name == "upright":
            which = given.upright_axis if isinstance(given.upright_axis, str) else f"[{_words(given.upright_axis)}]"
            return f"upright: the tool's {which} axis is {off:.2f} degrees from the vertical, {most:.2f} are allowed"
        at = _words(given.view)
        return f"view: ({at}) m is {off:.2f} degrees from the camera's axis, {most:.2f} are allowed"


def _least_step(rows: Vector, error: Vector, lower: Vector, upper: Vector) -> Vector:
    """The smallest steps, shape (N, n), that reduce errors, shape (N, K), by linear rates, shape (N, K, n).

    Joints that would pass a limit stay at it, and the others make up for them.

    Args:
        rows: derivatives of the errors by the joints.
        error: what to reduce.
        lower: at most 0, shape (N, n).
        upper: at least 0, shape (N, n).
    """
    identity = _DAMPING * np.eye(rows.shape[1])
    free = np.ones_like(lower, dtype=bool)
    step = np.zeros_like(lower)
    for _ in range(2):
        usable = rows * free[:, None, :]
        left = error + (rows @ np.where(free, 0.0, step)[..., None])[..., 0]
        solved = np.linalg.solve(usable @ usable.mT + identity, left[..., None])
        step = np.where(free, -(usable.mT @ solved)[..., 0], step)
        beyond = free & ((step < lower) | (step > upper))
        step = np.clip(step, lower, upper)
        if not beyond.any():
            break
        free &= ~beyond
    return step


def _angle(a: Vector, b: Vector) -> Vector:
    """Angles between unit vectors, shape (…)."""
    b = np.broadcast_to(b, a.shape)
    return np.arctan2(np.linalg.norm(cross(a, b), axis=-1), (a * b).sum(axis=-1))


def _normal(a: Vector, b: Vector) -> Vector:
    """Unit vectors about which `a` turns towards `b` on the shortest way, shape (…, 3); any for opposite ones."""
    b = np.broadcast_to(b, a.shape)
    normal = cross(a, b)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    other = cross(a, np.where(np.abs(a[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    normal = np.where(length > 1e-9, normal, other)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), _TINY))


def _words(values: object) -> str:
    assert isinstance(values, tuple)
    return ", ".join(f"{each:g}" for each in values)
