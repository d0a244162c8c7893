"""Inverse kinematics of a stream of poses: from each to the next on the same branch, in bounded time."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.model import KinematicModel
from ibrobot_kinematics.rotations import log
from ibrobot_kinematics.target import Target

WEIGHT = 100.0
"""Weight of position errors against those of the orientation [rad/m]."""
_ITERATIONS = 25
"""Bound on the work for a pose. From the pose before, a search takes three or four."""
_LONGEST_STEP = 0.5
"""Maximum change of a joint per iteration [rad or m], so that a search stays on its branch."""
_CONVERGED = 1e-8
_SETTLED = 1e-3
"""A search has found a pose if its last step changed no joint by more [rad or m]; it ends at `_CONVERGED`."""
_DAMPING, _LEAST_DAMPING, _FACTOR = 1e-4, 1e-9, 10.0
"""Of Levenberg and Marquardt: at first, at least (well above the rounding of its matrix), and how it changes."""


def follow(model: KinematicModel, target: Target, start: Vector) -> Vector | None:
    """Joint positions nearest to a target, searched from `start`; None if the search does not end.

    The search minimises the squares of the position error, times `WEIGHT`, and of the angle, by Levenberg and
    Marquardt's method within the limits. Equal arguments give equal positions.

    Args:
        model: the arm, all of whose joints move the tip.
        target: a position, with or without a rotation.
        start: joint positions within the limits, shape (J,).
    """
    q, damping, step_size = start, _DAMPING, np.inf
    error, jacobian = _error(model, target, q)
    cost = float(error @ error)
    for _ in range(_ITERATIONS):
        gradient, normal = jacobian.T @ error, jacobian.T @ jacobian
        # A joint at its limit that would go beyond it stays there.
        free = ~(((q <= model.lower) & (gradient < 0)) | ((q >= model.upper) & (gradient > 0)))
        if not free.any():
            return q
        inside = normal[np.ix_(free, free)] + damping * np.eye(int(free.sum()))
        step = np.zeros_like(q)
        step[free] = np.linalg.solve(inside, gradient[free])
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), _CONVERGED))
        trial = np.clip(q + step, model.lower, model.upper)
        step_size = float(np.abs(trial - q).max())
        if step_size < _CONVERGED:
            return q
        error_there, jacobian_there = _error(model, target, trial)
        if (there := float(error_there @ error_there)) <= cost:
            q, cost, error, jacobian = trial, there, error_there, jacobian_there
            damping = max(damping / _FACTOR, _LEAST_DAMPING)
        else:
            damping *= _FACTOR
    return q if step_size < _SETTLED else None


def _error(model: KinematicModel, target: Target, q: Vector) -> tuple[Vector, Vector]:
    """The weighted errors and their derivatives by the joints."""
    tip, linear, angular = model.twists(q)
    away, moves = WEIGHT * (target.position - tip.position), WEIGHT * linear.T
    if target.rotation is None:
        return away, moves
    return np.concatenate([away, log(target.rotation @ tip.rotation.T)]), np.concatenate([moves, angular.T])
