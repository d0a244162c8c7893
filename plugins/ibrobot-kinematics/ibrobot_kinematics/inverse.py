"""Inverse kinematics: joint positions that bring the tip to a target."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.closed_form import Candidates, PanPlanarRoll, closed_form
from ibrobot_kinematics.errors import KinematicsError, UnreachableError
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
_EXACT_M = 1e-6
_EXACT_RAD = 1e-6
_POLISHED = 2
"""Searches from the nearest misses of the closed form before a target counts as unreachable."""
_POLISHING = 15
"""Iterations of such a search."""
_CLOSE_M = 0.005
_CLOSE_RAD = 0.05
"""Where the nearest miss is within both, the searches of the numerical solver follow."""

type Indices = np.ndarray[tuple[int], np.dtype[np.intp]]


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

    In closed form for an arm with a pan joint, three parallel joints and a roll about the tool, as the SO-101, and a
    target without a rotation: a branch near `start`, see `solve_all`. Numerical otherwise:
    Levenberg-Marquardt steps within the limits, from `start`, then from the middle of the limits, then from a fixed
    sequence of configurations. The position is met before the orientation where the arm cannot do both. Equal arguments
    give equal bits.

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
    arm = _closed_form_for(model, target)
    if arm is not None:
        return _branches(model, arm, target, start, position_tolerance, rotation_tolerance, every=False)[0]
    found: list[tuple[float, Vector, float, float]] = []
    for begin in _starts(model, np.clip(start, model.lower, model.upper)):
        q = _descend(model, target, begin)
        off, turned = _missed(model, target, q)
        if off <= position_tolerance and turned <= rotation_tolerance:
            return q
        found.append((np.hypot(_POSITION_WEIGHT * off, turned), q, off, turned))
    _, nearest, off, turned = min(found, key=lambda each: each[0])
    raise _unreachable(model, target, nearest, off, turned)


def solve_all(
    model: KinematicModel,
    target: Target,
    start: Vector | None = None,
    *,
    position_tolerance: float = POSITION_TOLERANCE_M,
    rotation_tolerance: float = ROTATION_TOLERANCE_RAD,
) -> list[Vector]:
    """One solution of each branch within the limits, by closed form, the nearest to `start` first.

    A position with an axis has up to eight branches: two of the pan, the roll and the elbow each. Where the target
    leaves joints free, i.e. the pitch and roll at a position alone, or the pan at an axis along the pan's, they are
    sampled, and each branch gives its sample nearest to `start`. When no branch meets the target exactly, the result is
    the one solution that a search from the nearest misses finds within the tolerances.

    Args:
        model: an arm with a pan joint, three parallel joints and a roll about the tool.
        target: where to bring the tip: a position, alone or with an axis.
        start: where joints are, shape (J,); None: the middle of the limits. Joints that do not move the tip stay there.
        position_tolerance: as in `solve`.
        rotation_tolerance: as in `solve`.

    Returns:
        Joint positions [rad], each of shape (J,); at least one.

    Raises:
        KinematicsError: when there is no closed form for the arm or the target.
        UnreachableError: when no solution is within the tolerances.
    """
    arm = _closed_form_for(model, target)
    if arm is None:
        raise KinematicsError(
            f"{model.tip}: no closed form for this arm and target; it needs a pan joint, three parallel joints across"
            " the pan's axis, a roll about the tool, and a target without a rotation; use solve()"
        )
    if start is None:
        start = (model.lower + model.upper) / 2
    return _branches(model, arm, target, start, position_tolerance, rotation_tolerance, every=True)


def _closed_form_for(model: KinematicModel, target: Target) -> PanPlanarRoll | None:
    if target.rotation is not None:
        return None
    arm = closed_form(model)
    return None if arm is None or (target.axis is not None and arm.points == 0) else arm


def _branches(
    model: KinematicModel, arm: PanPlanarRoll, target: Target, start: Vector, position_tolerance: float,
    rotation_tolerance: float, *, every: bool,
) -> list[Vector]:  # fmt: skip
    """What `solve_all` returns; where not `every` branch is wanted, coarse samples come first."""
    start = np.clip(start, model.lower, model.upper)
    chain = start[model.moving]
    near_misses: list[tuple[float, Vector]] = []
    for candidates in _samples(arm, target, chain, every):
        exact = np.flatnonzero((candidates.off < _EXACT_M) & (candidates.turned < _EXACT_RAD))
        if len(exact):
            distance = ((candidates.joints[exact] - chain) ** 2).sum(axis=1)
            ranked = _one_each(candidates, exact[np.argsort(distance, kind="stable")])
            solutions = [_placed(model, start, candidates.joints[i]) for i in ranked]
            off, turned = _missed(model, target, solutions[0])
            if off > _EXACT_M or turned > _EXACT_RAD:
                # The model deviates from the ideal geometry within its rounding.
                solutions = [_descend(model, target, q, _POLISHING) for q in solutions]
            return solutions
        missed = np.hypot(_POSITION_WEIGHT * candidates.off, candidates.turned)
        best = _one_each(candidates, np.argsort(missed, kind="stable"))[:_POLISHED]
        near_misses += [(missed[i], _placed(model, start, candidates.joints[i])) for i in best]
    near_misses.sort(key=lambda each: each[0])
    found: list[tuple[float, Vector, float, float]] = []
    searches = ((begin, _POLISHING) for _, begin in near_misses[:_POLISHED])
    widely = ((begin, _ITERATIONS) for begin in _starts(model, start))
    for number, (begin, iterations) in enumerate(itertools.chain(searches, widely)):
        if number >= _POLISHED and not any(off < _CLOSE_M and turned < _CLOSE_RAD for _, _, off, turned in found):
            break
        q = _descend(model, target, begin, iterations)
        off, turned = _missed(model, target, q)
        if off <= position_tolerance and turned <= rotation_tolerance:
            return [q]
        found.append((np.hypot(_POSITION_WEIGHT * off, turned), q, off, turned))
    _, nearest, off, turned = min(found, key=lambda each: each[0])
    raise _unreachable(model, target, nearest, off, turned)


def _samples(arm: PanPlanarRoll, target: Target, chain: Vector, every: bool) -> Iterator[Candidates]:
    """Candidates, ever more."""
    if target.axis is not None:
        yield arm.with_axis(target.position, target.axis, chain)
    elif not every:
        yield arm.at(target.position, None, chain, pitches=24, rolls=1)
    yield arm.at(target.position, target.axis, chain, pitches=60, rolls=13)


def _one_each(candidates: Candidates, ranked: Indices) -> list[int]:
    """The first of each branch."""
    first: dict[int, int] = {}
    for branch, index in zip(candidates.branch[ranked].tolist(), ranked.tolist(), strict=True):
        first.setdefault(branch, index)
    return list(first.values())


def _placed(model: KinematicModel, start: Vector, joints: Vector) -> Vector:
    """Positions of all joints, with these of the chain's."""
    q = start.copy()
    q[model.moving] = joints
    return q


def _missed(model: KinematicModel, target: Target, q: Vector) -> tuple[float, float]:
    """How far the tip is from the target, [m] and [rad]."""
    error = _error(target, model.forward(q))
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


def _unreachable(model: KinematicModel, target: Target, nearest: Vector, off: float, turned: float) -> UnreachableError:
    x, y, z = target.position
    return UnreachableError(
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


def _descend(model: KinematicModel, target: Target, start: Vector, iterations: int = _ITERATIONS) -> Vector:
    """The configuration nearest to the target that a search from `start` finds."""
    moving = model.moving
    lower, upper = model.lower[moving], model.upper[moving]
    weights = np.array([_POSITION_WEIGHT] * 3 + [1.0] * 3)
    q, damping = start, 1e-2
    tip, jacobian = model.forward_and_jacobian(q)
    error = weights * _error(target, tip)
    for _ in range(iterations):
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
