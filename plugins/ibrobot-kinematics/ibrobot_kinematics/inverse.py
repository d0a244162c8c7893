"""Inverse kinematics: joint positions that bring the tip to a target."""

from __future__ import annotations

from collections.abc import Iterator

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.errors import UnreachableError
from ibrobot_kinematics.model import KinematicModel, TipPose
from ibrobot_kinematics.quadratic import bounded_minimum
from ibrobot_kinematics.rotations import cross, log

POSITION_TOLERANCE_M = 1e-3
ROTATION_TOLERANCE_RAD = 0.01
_POSITION_WEIGHT = 100.0
"""A centimetre weighs as much as a radian: where both cannot be had the position is, and the orientation nearly."""
_ITERATIONS = 60
_STARTS = 20
"""Searches before a target counts as unreachable."""
_LONGEST_STEP = 0.5
"""No joint moves further in one step [rad or m], so that a search stays on the branch where it begins."""
_CONVERGED = 1e-7
"""A step of no joint beyond this [rad or m] ends a search."""
_ORTHONORMAL = 1e-6


@attrs.frozen(eq=False)
class Target:
    """Where to bring the tip: a position, alone or with an orientation or the direction of one axis.

    Raises:
        ValueError: when a value has another shape, is not finite, is not a rotation matrix or unit vector, or when both
            `rotation` and `axis` are given.
    """

    position: Vector = attrs.field(converter=np.asarray)
    """Origin of the tip in the base frame [m], shape (3,)."""
    rotation: Vector | None = None
    """Axes of the tip in the base frame, as columns, shape (3, 3)."""
    axis: Vector | None = None
    """Direction of the tip's z axis in the base frame, a unit vector, shape (3,): what an arm of five joints can do."""

    def __attrs_post_init__(self) -> None:
        for name, value, shape in (
            ("position", self.position, (3,)), ("rotation", self.rotation, (3, 3)), ("axis", self.axis, (3,)),
        ):  # fmt: skip
            if value is not None and (np.shape(value) != shape or not np.isfinite(value).all()):
                raise ValueError(f"{name} must be finite with shape {shape}, got {np.asarray(value).tolist()}")
        if self.rotation is not None:
            if self.axis is not None:
                raise ValueError("a target has a rotation or an axis, not both")
            if np.abs(self.rotation.T @ self.rotation - np.eye(3)).max() > _ORTHONORMAL or (
                np.linalg.det(self.rotation) < 0
            ):
                raise ValueError(f"rotation must be a rotation matrix, got {self.rotation.tolist()}")
        if self.axis is not None and abs(np.linalg.norm(self.axis) - 1) > _ORTHONORMAL:
            raise ValueError(f"axis must be a unit vector, got {self.axis.tolist()}")


def solve(
    model: KinematicModel,
    target: Target,
    start: Vector,
    *,
    position_tolerance: float = POSITION_TOLERANCE_M,
    rotation_tolerance: float = ROTATION_TOLERANCE_RAD,
) -> Vector:
    """Joint positions within the limits that bring the tip to `target`.

    Numerical: Levenberg-Marquardt steps within the limits, from `start`, then from the middle of the limits, then from
    a fixed sequence of configurations. The position is met before the orientation where the arm cannot do both. Equal
    arguments give equal bits.

    Args:
        model: the arm.
        target: where to bring the tip.
        start: where the search begins, shape (J,); of several solutions one near it is likely. Joints that do not move
            the tip stay there.
        position_tolerance: how far [m] from the target the tip may be.
        rotation_tolerance: how far [rad] the tip may turn away from the target's rotation or axis where the arm cannot
            do better.

    Returns:
        Joint positions [rad or m], shape (J,).

    Raises:
        UnreachableError: when no search ends within the tolerances.
    """
    found: list[tuple[float, Vector, float, float]] = []
    for begin in _starts(model, np.clip(start, model.lower, model.upper)):
        q = _descend(model, target, begin)
        error = _error(target, model.forward(q))
        off, turned = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        if off <= position_tolerance and turned <= rotation_tolerance:
            return q
        found.append((np.hypot(_POSITION_WEIGHT * off, turned), q, off, turned))
    _, nearest, off, turned = min(found, key=lambda each: each[0])
    x, y, z = target.position
    raise UnreachableError(
        f"{model.tip} cannot reach ({x:.3f}, {y:.3f}, {z:.3f}) m as asked within the joint limits;"
        f" the nearest found is {1000 * off:.0f} mm and {np.degrees(turned):.0f} degrees off",
        nearest,
        off,
        turned,
    )


def _starts(model: KinematicModel, start: Vector) -> Iterator[Vector]:
    """Where searches begin; joints that do not move the tip are at `start`."""
    yield start
    moving = model.moving
    lower, upper = model.lower[moving], model.upper[moving]
    shares = np.vstack([np.full(len(moving), 0.5), np.random.default_rng(0).random((_STARTS - 2, len(moving)))])
    for share in shares:
        begin = start.copy()
        begin[moving] = lower + share * (upper - lower)
        yield begin


def _descend(model: KinematicModel, target: Target, start: Vector) -> Vector:
    """The configuration nearest to the target that a search from `start` finds."""
    moving = model.moving
    lower, upper = model.lower[moving], model.upper[moving]
    weights = np.array([_POSITION_WEIGHT] * 3 + [1.0] * 3)
    q, damping = start, 1e-2
    tip, jacobian = model.forward_and_jacobian(q)
    error = weights * _error(target, tip)
    for _ in range(_ITERATIONS):
        weighted = weights[:, None] * _error_rates(target, tip, jacobian[:, moving])
        hessian = weighted.T @ weighted + damping * np.eye(len(moving))
        here = q[moving]
        step = bounded_minimum(
            hessian,
            weighted.T @ error,
            np.maximum(lower - here, -_LONGEST_STEP),
            np.minimum(upper - here, _LONGEST_STEP),
        )
        trial = q.copy()
        trial[moving] = np.clip(here + step, lower, upper)
        tip_there, jacobian_there = model.forward_and_jacobian(trial)
        error_there = weights * _error(target, tip_there)
        if error_there @ error_there < error @ error:
            q, tip, jacobian, error = trial, tip_there, jacobian_there, error_there
            damping = max(damping / 5, 1e-4)
        else:
            damping *= 4
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break
    return q


def _error(target: Target, tip: TipPose) -> Vector:
    """How far the tip is from the target in the base frame, [m] and as a rotation vector [rad], shape (6,)."""
    if target.rotation is not None:
        turn = log(tip.rotation @ target.rotation.T)
    elif target.axis is not None:
        turn = _between(target.axis, tip.rotation[:, 2], tip.rotation[:, 0])
    else:
        turn = np.zeros(3)
    return np.concatenate([tip.position - target.position, turn])


def _between(a: Vector, b: Vector, otherwise: Vector) -> Vector:
    """Shortest rotation vector [rad] that turns `a` to `b`, unit vectors; about `otherwise` where they are opposite."""
    normal = cross(a, b)
    sine = float(np.linalg.norm(normal))
    angle = np.arctan2(sine, a @ b)
    if sine > 0:
        return np.asarray(normal * (angle / sine))
    return otherwise * angle


def _error_rates(target: Target, tip: TipPose, jacobian: Vector) -> Vector:
    """Rows of the Jacobian that the target asks for; the others are zero."""
    if target.rotation is not None:
        return jacobian
    rates = jacobian.copy()
    if target.axis is None:
        rates[3:] = 0.0
    else:
        axis = tip.rotation[:, 2]
        rates[3:] -= np.outer(axis, axis @ jacobian[3:])
    return rates
