"""Numerical inverse kinematics: many parallel searches within the limits by Newton's method."""

from __future__ import annotations

from functools import lru_cache

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.model import KinematicModel, TipPose
from ibrobot_kinematics.rotations import cross
from ibrobot_kinematics.target import Target

_LONGEST_STEP = 0.5
"""Maximum change of a joint per step [rad or m], so that a search stays on its branch."""
_CONVERGED = 1e-7
"""A search ends if no joint changes by more than this in a step [rad or m]."""
_NO_GAIN = 1e-9
"""A search ends if the relative improvement of a step is smaller."""
_DAMPING, _LEAST_DAMPING = 1e-2, 1e-9
_BOUND_PASSES = 2
_TABLE_SIZE = 4096
TABLE_LEVER_M = 0.3
"""Weight of rotation when looking up starting points: a radian counts as much as this distance [m]."""

type Flags = np.ndarray[tuple[int], np.dtype[np.bool_]]


@attrs.frozen(eq=False)
class Results:
    """Results of searches."""

    joints: Vector
    """Joint positions [rad or m], shape (N, J)."""
    off: Vector
    """Distance of the tip from the target [m], shape (N,)."""
    turned: Vector
    """Angle between the tip and the target [rad], shape (N,)."""

    def within(self, off: float, turned: float) -> Flags:
        """Whether each result meets the target, shape (N,)."""
        return np.asarray((self.off <= off) & (self.turned <= turned))

    def best(self, number: int, position_weight: float) -> Vector:
        """Joint positions with the smallest errors by `search`'s measure, best first, shape (at most number, J)."""
        missed = np.hypot(position_weight * self.off, self.turned)
        return np.asarray(self.joints[np.argsort(missed, kind="stable")[:number]])


def search(
    model: KinematicModel,
    target: Target,
    starts: Vector,
    *,
    position_weight: float,
    iterations: int,
    stop_within: tuple[float, float] | None = None,
    shifts: Vector | None = None,
) -> Results:
    """Search for the configurations nearest to the target from `starts`.

    A search minimises `(position_weight * distance)**2 + turn**2`, where the turn is the chord of the angle. It takes
    Newton steps with exact second derivatives, made positive definite and damped. All searches end as soon as one of
    them meets the target.

    Args:
        model: the arm.
        target: target of the tip.
        starts: joint positions within the limits [rad or m], shape (N, J).
        position_weight: weight of position errors [rad/m].
        iterations: maximum number of iterations.
        stop_within: distance [m] and angle [rad] within which the target is met.
        shifts: shift of the target in each search [m], shape (N, 3).
    """
    moving = model.moving
    lower, upper = model.lower[moving], model.upper[moving]
    requested = np.tile(target.columns, (len(starts), 1, 1))
    if shifts is not None:
        requested[:, 0] += shifts
    weights = np.full(requested.shape[1], 1.0 if target.rotation is None else np.sqrt(0.5))
    weights[0] = position_weight
    after = np.triu(np.ones((len(moving), len(moving)), dtype=bool))

    def derivatives(q: Vector) -> tuple[TipPose, Vector, Vector, Vector]:
        """The tip, the objective, shape (N,), and half of its first and second derivatives by the joints."""
        tip, linear, axes = model.twists(q)
        columns = target.columns_of(tip)
        error = weights[:, None] * (columns - requested)
        # Derivative of each column by each joint, shape (N, n, K, 3).
        rates = cross(axes[:, :, None], columns[:, None])
        rates[:, :, 0] = linear
        rates *= weights[:, None]
        flat = rates.reshape(*rates.shape[:2], -1)
        gradient = (flat @ error.reshape(len(q), -1, 1))[..., 0]
        # A joint rotates the derivatives of itself and of all following joints.
        bent = axes @ cross(rates, error[:, None]).sum(axis=2).mT
        hessian = flat @ flat.mT + np.where(after, bent, bent.mT)
        return tip, (error**2).sum(axis=(1, 2)), gradient, hessian

    q, damping = starts.copy(), np.full(len(starts), _DAMPING)
    _, cost, gradient, hessian = derivatives(q)
    for _ in range(iterations):
        here = q[:, moving]
        step = _bounded_step(
            hessian,
            gradient,
            damping,
            np.maximum(lower - here, -_LONGEST_STEP),
            np.minimum(upper - here, _LONGEST_STEP),
        )
        ended = (np.abs(step).max(axis=1) < _CONVERGED) | (-(gradient * step).sum(axis=1) < _NO_GAIN * cost)
        if ended.all():
            break
        trial = q.copy()
        trial[:, moving] = np.clip(here + step, lower, upper)
        tip, *there = derivatives(trial)
        better = there[0] < cost
        q[better] = trial[better]
        for now, then in zip((cost, gradient, hessian), there, strict=True):
            now[better] = then[better]
        damping = np.where(better, np.maximum(damping / 10, _LEAST_DAMPING), damping * 4)
        if stop_within is not None:
            off, turned = target.missed(tip)
            if (better & (off <= stop_within[0]) & (turned <= stop_within[1])).any():
                break
    off, turned = target.missed(model.forward(q))
    return Results(q, off, turned)


def _bounded_step(hessian: Vector, gradient: Vector, damping: Vector, lower: Vector, upper: Vector) -> Vector:
    """Steps that reduce `x @ hessian @ x / 2 + gradient @ x` within bounds; joints that reach a bound stay there.

    Args:
        hessian: symmetric, shape (N, n, n); the absolute values of its eigenvalues are used.
        gradient: shape (N, n).
        damping: added to its eigenvalues, shape (N,).
        lower: at most 0, shape (N, n).
        upper: at least 0, shape (N, n).
    """
    step = np.zeros_like(gradient)
    held = ((lower >= 0) & (gradient > 0)) | ((upper <= 0) & (gradient < 0))
    identity = np.eye(gradient.shape[1])
    free = ~held
    hessian = np.where(free[:, :, None] & free[:, None, :], hessian, identity)
    values, vectors = np.linalg.eigh(hessian)
    hessian = (vectors * (np.abs(values) + damping[:, None])[:, None, :]) @ vectors.mT
    for _ in range(_BOUND_PASSES):
        free = ~held
        remaining = gradient + (hessian @ np.where(held, step, 0.0)[..., None])[..., 0]
        reduced = np.where(free[:, :, None] & free[:, None, :], hessian, identity)
        solved = np.linalg.solve(reduced, np.where(free, -remaining, 0.0)[..., None])[..., 0]
        step = np.where(held, step, solved)
        beyond = (step < lower) | (step > upper)
        step = np.clip(step, lower, upper)
        if not beyond.any():
            break
        held |= beyond
    return step


def starts_from_table(
    model: KinematicModel, target: Target, start: Vector, number: int, *, lever: float = TABLE_LEVER_M
) -> Vector:
    """Configurations whose tip is near the target, nearest first, shape (number, J).

    Args:
        model: the arm.
        target: target of the tip.
        start: positions of the joints that do not move the tip, shape (J,).
        number: number of configurations, at most the size of the table.
        lever: distance that counts as much as a rotation by one radian [m]; 0 for positions alone.
    """
    joints, tips = _table(model)
    off, turned = target.missed(tips)
    nearest = np.argsort(np.hypot(off, lever * turned), kind="stable")[:number]
    starts = np.tile(start, (number, 1))
    starts[:, model.moving] = joints[nearest]
    return starts


@lru_cache(maxsize=16)
def _table(model: KinematicModel) -> tuple[Vector, TipPose]:
    """Configurations throughout the limits, shape (N, n), and their tips."""
    lower, upper = model.lower[model.moving], model.upper[model.moving]
    joints = lower + _halton(_TABLE_SIZE, len(lower)) * (upper - lower)
    q = np.zeros((_TABLE_SIZE, len(model.joint_names)))
    q[:, model.moving] = joints
    return joints, model.forward(q)


def _halton(number: int, dimensions: int) -> Vector:
    """Points that fill the unit cube evenly, shape (number, dimensions). Source: J. Halton, 1964."""
    primes = [n for n in range(2, 100) if all(n % divisor for divisor in range(2, n))][:dimensions]
    columns = []
    for base in primes:
        rest, column, digit = np.arange(1, number + 1), np.zeros(number), 1.0
        while rest.any():
            digit /= base
            column += digit * (rest % base)
            rest //= base
        columns.append(column)
    return np.stack(columns, axis=1)
