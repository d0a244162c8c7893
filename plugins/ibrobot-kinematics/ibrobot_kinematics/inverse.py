"""Inverse kinematics: joint positions that bring the tip to a target."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.closed_form import Candidates, PanPlanarRoll, closed_form
from ibrobot_kinematics.errors import UnreachableError
from ibrobot_kinematics.model import KinematicModel
from ibrobot_kinematics.search import search, starts_from_table
from ibrobot_kinematics.target import Target

POSITION_TOLERANCE_M = 1e-3
ROTATION_TOLERANCE_RAD = 0.01
_EXACT_M = 1e-6
_EXACT_RAD = 1e-6
_POLISHING = 15
"""Iterations that take up the difference between the arm and its ideal geometry."""
_NEAR_MISSES = 2
"""Searches from the nearest misses of each branch of the closed form."""
_ROUNDS = (16, 100)
"""Searches side by side that follow one from the start."""
_SHORT, _LONG = 5, 15
"""Iterations of all of them, and of the best."""
_BEST = 4
_LEAST_WEIGHT, _WEIGHT, _GREAT_WEIGHT = 10.0, 100.0, 1e4
"""Radians that a metre counts: at least; where searches begin at the position already; where position comes first."""
_SHIFTS = 3
"""How often the target is shifted until its position is met and the orientation nearest."""
_ONE = 0.02
"""Solutions that differ in no joint by more [rad or m] are one."""

type Indices = np.ndarray[tuple[int], np.dtype[np.intp]]


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
    target without a rotation: a branch near `start`, see `solve_all`. Numerical otherwise: damped Newton searches
    within the limits, from `start`, then from configurations all over the limits whose tips are near the target. Equal
    arguments give equal bits.

    Args:
        model: the arm.
        target: where to bring the tip.
        start: where joints are, shape (J,); of several solutions one near it is likely. Joints that do not move the
            tip stay there.
        position_tolerance: how far [m] from the target the tip may be.
        rotation_tolerance: how far [rad] the tip may turn away from the target's rotation or axis where the arm cannot
            do better.

    Returns:
        Joint positions [rad or m], shape (J,).

    Raises:
        ValueError: for a start that is not finite or has another shape, or a tolerance that is not above zero.
        UnreachableError: when no search ends within the tolerances; it has the nearest point that the arm can reach.
    """
    return _solutions(model, target, start, position_tolerance, rotation_tolerance, every=False)[0]


def solve_all(
    model: KinematicModel,
    target: Target,
    start: Vector | None = None,
    *,
    position_tolerance: float = POSITION_TOLERANCE_M,
    rotation_tolerance: float = ROTATION_TOLERANCE_RAD,
) -> list[Vector]:
    """Different solutions within the limits, the nearest to `start` first.

    In closed form, as in `solve`, there is one of each branch. A position with an axis has up to eight: two of the pan,
    the roll and the elbow each. Where the target leaves joints free, i.e. the pitch and roll at a position alone, or
    the pan at an axis along the pan's, they are sampled, and each branch gives its sample nearest to `start`.
    Numerically, the solutions are those that searches from all over the limits find; an arm with joints to spare has
    endlessly many.

    Args:
        model: the arm.
        target: where to bring the tip.
        start: where joints are, shape (J,); None: the middle of the limits. Joints that do not move the tip stay there.
        position_tolerance: as in `solve`.
        rotation_tolerance: as in `solve`.

    Returns:
        Joint positions [rad or m], each of shape (J,); at least one.

    Raises:
        ValueError: as in `solve`.
        UnreachableError: as in `solve`.
    """
    if start is None:
        start = (model.lower + model.upper) / 2
    return _solutions(model, target, start, position_tolerance, rotation_tolerance, every=True)


def _solutions(
    model: KinematicModel, target: Target, start: Vector, position_tolerance: float, rotation_tolerance: float,
    *, every: bool,
) -> list[Vector]:  # fmt: skip
    if np.shape(start) != model.lower.shape or not np.isfinite(start).all():
        raise ValueError(f"start must be finite with shape {model.lower.shape}, got {np.asarray(start).tolist()}")
    for name, tolerance in (("position_tolerance", position_tolerance), ("rotation_tolerance", rotation_tolerance)):
        if not tolerance > 0:
            raise ValueError(f"{name} is {tolerance}, must be above 0")
    start = np.clip(start, model.lower, model.upper)
    near_misses = np.empty((0, len(start)))
    arm = _closed_form_for(model, target)
    if arm is not None:
        exact, near_misses = _by_closed_form(model, arm, target, start, every)
        if exact:
            return exact
    tolerances = position_tolerance, rotation_tolerance
    least = _LEAST_WEIGHT if arm is None else _WEIGHT
    weight = float(np.clip(rotation_tolerance / position_tolerance, least, _GREAT_WEIGHT))
    for starts in _rounds(model, target, start, near_misses, every):
        first = search(model, target, starts, position_weight=weight, iterations=_SHORT)
        found = search(
            model, target, first.best(len(starts) if every else _BEST, weight), position_weight=weight,
            iterations=_LONG, stop_within=None if every else tolerances,
        )  # fmt: skip
        solved = found.joints[found.within(*tolerances)]
        if len(solved):
            nearest_first = solved[np.argsort(((solved - start) ** 2).sum(axis=1), kind="stable")]
            return _distinct(search(model, target, nearest_first, position_weight=weight, iterations=_POLISHING).joints)
        near_misses = np.concatenate([near_misses, found.joints])
    nearest = _nearest(model, target, near_misses)
    tip = model.forward(nearest)
    off, turned = target.missed(tip)
    if off <= position_tolerance and turned <= rotation_tolerance:
        return [nearest]
    raise UnreachableError(model.tip, target.position, nearest, tip.position, float(off), float(turned))


def _rounds(model: KinematicModel, target: Target, start: Vector, near_misses: Vector, every: bool) -> Iterator[Vector]:
    """Where searches begin, round after round."""
    if len(near_misses):
        yield np.concatenate([near_misses, starts_from_table(model, target, start, _ROUNDS[0])])
        return
    if not every:
        yield start[None]
    table = starts_from_table(model, target, start, sum(_ROUNDS))
    yield from np.split(table, np.cumsum(_ROUNDS)[:-1])


def _closed_form_for(model: KinematicModel, target: Target) -> PanPlanarRoll | None:
    if target.rotation is not None:
        return None
    arm = closed_form(model)
    return None if arm is None or (target.axis is not None and arm.points == 0) else arm


def _by_closed_form(
    model: KinematicModel, arm: PanPlanarRoll, target: Target, start: Vector, every: bool
) -> tuple[list[Vector], Vector]:
    """Exact solutions, one of each branch, and where there are none the nearest misses, shape (N, J)."""
    chain = start[model.moving]
    near_misses = []
    for candidates in _samples(arm, target, chain, every):
        exact = np.flatnonzero((candidates.off < _EXACT_M) & (candidates.turned < _EXACT_RAD))
        if len(exact):
            distance = ((candidates.joints[exact] - chain) ** 2).sum(axis=1)
            ranked = exact[np.argsort(distance, kind="stable")]
            _, first = np.unique(candidates.branch[ranked], return_index=True)
            solutions = _placed(model, start, candidates.joints[ranked[np.sort(first)]])
            off, turned = target.missed(model.forward(solutions[0]))
            if off > _EXACT_M or turned > _EXACT_RAD:
                # The model deviates from the ideal geometry within its rounding.
                solutions = search(model, target, solutions, position_weight=_WEIGHT, iterations=_POLISHING).joints
            return list(solutions), solutions
        ranks = (
            np.argsort(np.hypot(weight * candidates.off, candidates.turned), kind="stable")
            for weight in (_WEIGHT, _GREAT_WEIGHT)
        )
        nearest = np.unique(np.concatenate([_first_of_each(candidates.branch, ranked) for ranked in ranks]))
        near_misses.append(candidates.joints[nearest])
    return [], _placed(model, start, np.concatenate(near_misses))


def _ranked(off: Vector, turned: Vector, weight: float) -> Indices:
    """Indices of what misses by these distances [m] and angles [rad], least first; `weight` is in [rad/m]."""
    return np.argsort(np.hypot(weight * off, turned), kind="stable")


def _first_of_each(branch: Indices, ranked: Indices, number: int = _NEAR_MISSES) -> Indices:
    """The first few of `ranked` of each branch."""
    order = np.argsort(branch[ranked], kind="stable")
    _, begins = np.unique(branch[ranked][order], return_index=True)
    rank_within = np.arange(len(ranked)) - np.repeat(begins, np.diff(np.append(begins, len(ranked))))
    return ranked[np.sort(order[rank_within < number])]


def _samples(arm: PanPlanarRoll, target: Target, chain: Vector, every: bool) -> Iterator[Candidates]:
    """Candidates, ever more."""
    if target.axis is not None:
        yield arm.with_axis(target.position, target.axis, chain)
    elif not every:
        yield arm.at(target.position, None, chain, pitches=24, rolls=1)
    yield arm.at(target.position, target.axis, chain, pitches=60, rolls=13)


def _placed(model: KinematicModel, start: Vector, joints: Vector) -> Vector:
    """Positions of all joints, shape (N, J), with these of the chain's, shape (N, n)."""
    q = np.tile(start, (len(joints), 1))
    q[:, model.moving] = joints
    return q


def _distinct(solutions: Vector) -> list[Vector]:
    kept: list[Vector] = []
    for q in solutions:
        if all(np.abs(q - other).max() > _ONE for other in kept):
            kept.append(q)
    return kept


def _nearest(model: KinematicModel, target: Target, near: Vector) -> Vector:
    """The joint positions nearest to the target, searched from the best of those given, shape (N, J).

    Its position is the nearest, and its orientation the nearest at that position. A great weight of the position alone
    would make searches slow. Hence the target is first shifted by what was missed, again and again (M. Hestenes,
    Multiplier and gradient methods, 1969).
    """
    off, turned = target.missed(model.forward(near))
    near = np.concatenate([near[_ranked(off, turned, weight)[:_BEST]] for weight in (_WEIGHT, _GREAT_WEIGHT)])
    shifted, shifts = near, np.zeros((len(near), 3))
    if len(target.columns) > 1:
        for _ in range(_SHIFTS):
            shifted = search(model, target, shifted, position_weight=_WEIGHT, iterations=_SHORT, shifts=shifts).joints
            shifts += target.position - model.forward(shifted).position
        near = np.concatenate([shifted, near[_BEST:]])
    found = search(model, target, near, position_weight=_GREAT_WEIGHT, iterations=_LONG)
    return np.asarray(found.best(1, _GREAT_WEIGHT)[0])
