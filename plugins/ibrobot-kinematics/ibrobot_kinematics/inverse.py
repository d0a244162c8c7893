"""Inverse kinematics: joint positions that bring the tip to a target."""

from __future__ import annotations

import math
from collections.abc import Iterator

import attrs
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
"""Iterations that correct the difference between the arm and its ideal geometry."""
_NEAR_MISSES = 2
"""Number of searches from the candidates with the smallest errors, per branch of the closed form."""
_ROUNDS = (12, 100)
"""Number of parallel searches after the one from the start."""
_SHORT, _LONG = 5, 15
"""Iterations of all searches, and of the best ones."""
_BEST = 4
_LEAST_WEIGHT, _WEIGHT, _GREAT_WEIGHT = 10.0, 100.0, 1e4
"""Weights of position errors [rad/m]: minimum; if searches begin at the position; if position has priority."""
_APART = 0.5
"""Searches for the nearest point begin at configurations that differ by more in a joint [rad or m]."""
_OUT_OF_REACH_M = 0.005
_BY_POSITION = 8
"""This many searches start near the position if all results miss it by more than `_OUT_OF_REACH_M`."""
_SHIFTS = 3
"""How often to shift the target, to meet its position with the nearest orientation."""
_FAR = 100.0
"""Targets farther than this many times the arm's reach are replaced by nearer ones for the search."""
_SAME = 0.02
"""Solutions whose joints all differ by less count as equal [rad or m]."""

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

    For an arm with a pan joint, three parallel joints and a roll about the tool, such as the SO-101, and a target
    without a rotation, the solution is in closed form, on a branch near `start`; see `solve_all`. Otherwise it is
    numerical: damped Newton searches within the limits, from `start`, then from configurations throughout the limits
    whose tips are near the target. Equal arguments give equal results, bit by bit.

    Args:
        model: the arm.
        target: target of the tip.
        start: initial joint positions [rad or m], shape (J,); a solution near them is preferred. Joints that do not
            move the tip keep their position.
        position_tolerance: allowed distance of the tip from the target [m].
        rotation_tolerance: allowed angle between the tip and the target's rotation or axis [rad], if the arm cannot
            reach it exactly.

    Returns:
        Joint positions [rad or m], shape (J,).

    Raises:
        ValueError: if `start` is not finite or has a wrong shape, or a tolerance is not positive.
        UnreachableError: if no solution is within the tolerances; has the nearest point that the arm can reach.
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

    In closed form (see `solve`), there is one solution per branch. A position with an axis has up to eight: two values
    each of pan, roll and elbow. If the target leaves joints free, they are sampled, and each branch returns its sample
    nearest to `start`. This concerns pitch and roll for a position alone, and the pan for an axis parallel to the
    pan's. Numerically, the solutions are those found by searches throughout the limits; a redundant arm has infinitely
    many.

    Args:
        model: the arm.
        target: target of the tip.
        start: initial joint positions [rad or m], shape (J,); None: the middle of the limits. Joints that do not move
            the tip keep their position.
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
    if np.abs(target.position).max() > _FAR * model.reach:
        return [_nearest_to_far(model, target, start, position_tolerance, rotation_tolerance)]
    near_misses = np.empty((0, len(start)))
    arm = _closed_form_for(model, target)
    if arm is not None:
        exact, near_misses = _by_closed_form(model, arm, target, start, every)
        if exact:
            return exact
    # A wider tolerance is for targets that the arm cannot reach exactly: it does not end searches earlier.
    tolerances = position_tolerance, min(rotation_tolerance, ROTATION_TOLERANCE_RAD)
    least = _LEAST_WEIGHT if arm is None else _WEIGHT
    weight = float(np.clip(tolerances[1] / position_tolerance, least, _GREAT_WEIGHT))
    for starts in _rounds(model, target, start, near_misses, every):
        first = search(model, target, starts, position_weight=weight, iterations=_SHORT)
        results = search(
            model,
            target,
            first.best(len(starts) if every else _BEST, weight),
            position_weight=weight,
            iterations=_LONG,
            stop_within=None if every else tolerances,
        )
        solved = results.joints[results.within(*tolerances)]
        if len(solved):
            nearest_first = solved[np.argsort(((solved - start) ** 2).sum(axis=1), kind="stable")]
            return _distinct(search(model, target, nearest_first, position_weight=weight, iterations=_POLISHING).joints)
        near_misses = np.concatenate([near_misses, results.joints])
    nearest = _nearest(model, target, near_misses)
    tip = model.forward(nearest)
    off, turned = target.missed(tip)
    if off <= position_tolerance and turned <= rotation_tolerance:
        return [nearest]
    raise UnreachableError(model.tip, target.position, nearest, tip.position, float(off), float(turned))


def _nearest_to_far(
    model: KinematicModel, target: Target, start: Vector, position_tolerance: float, rotation_tolerance: float
) -> Vector:
    """Solve for a target far beyond reach by a nearer one, since squares would overflow."""
    share = _FAR * model.reach / float(np.abs(target.position).max())
    nearer = attrs.evolve(target, position=share * target.position)
    try:
        nearest = _solutions(model, nearer, start, POSITION_TOLERANCE_M, rotation_tolerance, every=False)[0]
    except UnreachableError as error:
        nearest = error.nearest
    tip = model.forward(nearest)
    off, turned = math.dist(target.position, tip.position), float(nearer.missed(tip)[1])
    if off <= position_tolerance and turned <= rotation_tolerance:
        return nearest
    raise UnreachableError(model.tip, target.position, nearest, tip.position, off, turned)


def _rounds(model: KinematicModel, target: Target, start: Vector, near_misses: Vector, every: bool) -> Iterator[Vector]:
    """Yield the starting points of searches, round by round."""
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
    """Exact solutions, one per branch; without any, the candidates with the smallest errors, shape (N, J)."""
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
                # The model deviates slightly from the ideal geometry, within its rounding.
                solutions = search(model, target, solutions, position_weight=_WEIGHT, iterations=_POLISHING).joints
            return list(solutions), solutions
        ranks = (_ranked(candidates.off, candidates.turned, weight) for weight in (_WEIGHT, _GREAT_WEIGHT))
        nearest = np.unique(np.concatenate([_first_of_each(candidates.branch, ranked) for ranked in ranks]))
        near_misses.append(candidates.joints[nearest])
    return [], _placed(model, start, np.concatenate(near_misses))


def _ranked(off: Vector, turned: Vector, weight: float) -> Indices:
    """Indices sorted by error, from distances [m] and angles [rad]; `weight` is in [rad/m]."""
    return np.argsort(np.hypot(weight * off, turned), kind="stable")


def _first_of_each(branch: Indices, ranked: Indices, number: int = _NEAR_MISSES) -> Indices:
    """The first few indices of `ranked` in each branch."""
    order = np.argsort(branch[ranked], kind="stable")
    _, begins = np.unique(branch[ranked][order], return_index=True)
    rank_within = np.arange(len(ranked)) - np.repeat(begins, np.diff(np.append(begins, len(ranked))))
    return ranked[np.sort(order[rank_within < number])]


def _samples(arm: PanPlanarRoll, target: Target, chain: Vector, every: bool) -> Iterator[Candidates]:
    """Yield candidates, with increasingly fine sampling."""
    if target.axis is not None:
        yield arm.with_axis(target.position, target.axis, chain)
    elif not every:
        yield arm.at(target.position, None, chain, pitches=24, rolls=1)
    # With an axis, these are only starting points of searches.
    yield arm.at(target.position, target.axis, chain, pitches=60 if target.axis is None else 36, rolls=13)


def _placed(model: KinematicModel, start: Vector, joints: Vector) -> Vector:
    """Positions of all joints, shape (N, J), with the given positions of the chain, shape (N, n)."""
    q = np.tile(start, (len(joints), 1))
    q[:, model.moving] = joints
    return q


def _distinct(solutions: Vector, apart: float = _SAME, most: int | None = None) -> list[Vector]:
    """Drop near-duplicates, whose joints all differ by at most `apart` [rad or m]; keep at most `most`."""
    kept: list[Vector] = []
    for q in solutions:
        if all(np.abs(q - other).max() > apart for other in kept):
            kept.append(q)
            if len(kept) == most:
                break
    return kept


def _nearest(model: KinematicModel, target: Target, near: Vector) -> Vector:
    """The joint positions nearest to the target, searched from the best of `near`, shape (N, J).

    Minimises the position error first, then the orientation error. A large weight of the position would make searches
    slow, so the target is repeatedly shifted by the remaining error instead (M. Hestenes, Multiplier and gradient
    methods, 1969).
    """
    off, turned = target.missed(model.forward(near))
    by_weight = (near[_ranked(off, turned, weight)] for weight in (_WEIGHT, _GREAT_WEIGHT))
    begin = np.array([q for ranked in by_weight for q in _distinct(ranked, _APART, _BEST)])
    iterations = _LONG
    if len(target.columns) == 1:
        near = begin
    elif off.min() > _OUT_OF_REACH_M:
        near = np.concatenate([begin, starts_from_table(model, target, near[0], _BY_POSITION, lever=0.0)])
    else:
        near, shifts, iterations = begin, np.zeros((len(begin), 3)), _SHORT
        for _ in range(_SHIFTS):
            near = search(model, target, near, position_weight=_WEIGHT, iterations=_SHORT, shifts=shifts).joints
            shifts += target.position - model.forward(near).position
    results = search(model, target, near, position_weight=_GREAT_WEIGHT, iterations=iterations)
    near = np.concatenate([results.joints, begin])
    return np.asarray(near[_ranked(*target.missed(model.forward(near)), _GREAT_WEIGHT)[0]])
