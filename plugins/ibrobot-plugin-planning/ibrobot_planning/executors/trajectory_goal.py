"""Points of trajectories as arrays, and goals in the executor's order of joints; both checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import FollowTrajectory, GoalRejected, JointTrajectory, JointTrajectoryPoint, Vector, ns
from ibrobot_planning.executors.options import TrajectoryOptions

_LONGEST_S = 86_400.0
"""Largest `goal_time` [s]."""
_WIDEST_RAD = 100.0
"""Largest tolerance; to check none, a goal says -1."""
PLAUSIBLE = 10.0
"""Largest velocity and acceleration of a point, as a share of the limits: whatever is above is a mistake."""
BEYOND_RAD = 2e-5
"""Allowed excess of positions beyond a limit, for rounding."""
_LARGEST = 1e6
"""Largest number of a trajectory's points, in whatever unit: its sums stay finite."""
STILL = 1e-6
"""Velocities [rad/s] that count as rest."""
_SHARES = np.linspace(0.0, 1.0, 65)
"""Where pieces of a spline that may leave the limits are sampled."""


@attrs.frozen(eq=False)
class Points:
    """The points of a trajectory: N points of J joints."""

    times_ns: NDArray[np.int64]
    """From the start, not negative, strictly increasing [ns], shape (N,)."""
    positions: Vector
    """[rad], shape (N, J)."""
    velocities: Vector | None
    """[rad/s], shape (N, J)."""
    accelerations: Vector | None
    """[rad/s^2], shape (N, J)."""


@attrs.frozen(eq=False)
class CheckedTrajectory:
    """A trajectory in the executor's order of joints."""

    points: Points
    path_tolerance: Vector
    """[rad], shape (J,); 0: not checked."""
    goal_tolerance: Vector
    """[rad], shape (J,); 0: not checked."""
    goal_time_ns: int
    """[ns]; 0: no limit."""


def check_trajectory(goal: FollowTrajectory, joints: Sequence[str], options: TrajectoryOptions) -> CheckedTrajectory:
    """Check a goal for the executor's `joints`.

    Raises:
        GoalRejected: for the first fault.
    """
    return CheckedTrajectory(
        points_of(goal.trajectory, joints),
        path_tolerance=_tolerance(goal.path_tolerance, "path_tolerance", options.path_tolerance, joints),
        goal_tolerance=_tolerance(goal.goal_tolerance, "goal_tolerance", options.goal_tolerance, joints),
        goal_time_ns=ns(_setting(goal.goal_time, options.goal_time, "goal_time", _LONGEST_S)),
    )


def points_of(trajectory: JointTrajectory, joints: Sequence[str]) -> Points:
    """The points of a trajectory that ends at rest, in the order of `joints`.

    Raises:
        GoalRejected: for the first fault, e.g. times that do not increase, or numbers that are missing or not finite.
    """
    order, points = _order(trajectory.joint_names, joints), trajectory.points
    if not points:
        raise GoalRejected("the trajectory has no points; it needs at least one")
    times_ns = _times(points)
    positions, velocities, accelerations, efforts = (
        _field([getattr(point, name) for point in points], name, order)
        for name in ("positions", "velocities", "accelerations", "effort")
    )
    if positions is None:
        raise GoalRejected("the points have no positions; every point needs them")
    if efforts is not None:
        raise GoalRejected("the points have efforts; only positions, velocities and accelerations are followed")
    if accelerations is not None and velocities is None:
        raise GoalRejected("the points have accelerations but no velocities; give both, or positions alone")
    if velocities is not None:
        check_rest(velocities[-1], "last", joints)
    return Points(times_ns, positions, velocities, accelerations)


def check_rest(velocities: Vector, which: str, joints: Sequence[str]) -> None:
    """Refuse a first or last point that is not at rest, by its velocities [rad/s], shape (J,).

    Raises:
        GoalRejected: for the joint that moves fastest.
    """
    joint = int(np.abs(velocities).argmax())
    if abs(velocities[joint]) > STILL:
        raise GoalRejected(
            f"the {which} point has {joints[joint]} at {velocities[joint]:.6g} rad/s; it must be at rest"
        )


def check_rates(points: Points, joints: Sequence[str], velocity: Vector, acceleration: Vector, most: float) -> None:
    """Refuse velocities and accelerations of points that are beyond the limits of the joints, each shape (J,).

    Args:
        points: the points.
        joints: names of their joints.
        velocity: limits [rad/s].
        acceleration: limits [rad/s^2].
        most: largest permitted share of the limits.

    Raises:
        GoalRejected: for the joint that exceeds a limit most.
    """
    for what, unit, values, limits in (
        ("a velocity", "rad/s", points.velocities, velocity),
        ("an acceleration", "rad/s²", points.accelerations, acceleration),
    ):
        if values is not None and not (np.abs(values) <= most * limits).all():
            number, joint = np.unravel_index(int((np.abs(values) / limits).argmax()), values.shape)
            fault = f"{what} of {values[number, joint]:.4g} {unit}; its limit is {limits[joint]:.4g} {unit}"
            raise GoalRejected(f"point {number} of the trajectory gives {joints[int(joint)]} {fault}")


def check_positions(
    times_ns: NDArray[np.int64], fields: Sequence[Vector], joints: Sequence[str], lower: Vector, upper: Vector
) -> None:
    """Refuse a spline that leaves the position limits, at its points or between them.

    Args:
        times_ns: times of the points [ns], shape (N,).
        fields: positions [rad], and, if given, velocities and accelerations of the points, each shape (N, J).
        joints: their names.
        lower: lower limits [rad], shape (J,).
        upper: upper limits [rad], shape (J,).

    Raises:
        GoalRejected: for the joint that leaves them furthest.
    """
    positions = fields[0]
    # A joint may begin outside its limits, and move inwards.
    lower, upper = np.minimum(lower, positions[0]) - BEYOND_RAD, np.maximum(upper, positions[0]) + BEYOND_RAD
    _check_inside(positions, times_ns, joints, lower, upper)
    if len(fields) == 1:
        return
    h = (np.diff(times_ns) / 1e9)[:, None]
    # The curve stays within the hull of its control points (Bernstein): only pieces whose hull leaves are sampled.
    v0, v1 = fields[1][:-1] * h, fields[1][1:] * h
    if len(fields) == 2:
        control = [positions[:-1], positions[:-1] + v0 / 3, positions[1:] - v1 / 3, positions[1:]]
    else:
        a0, a1 = fields[2][:-1] * h**2, fields[2][1:] * h**2
        control = [
            positions[:-1],
            positions[:-1] + v0 / 5,
            positions[:-1] + 2 * v0 / 5 + a0 / 20,
            positions[1:] - 2 * v1 / 5 + a1 / 20,
            positions[1:] - v1 / 5,
            positions[1:],
        ]
    hull = np.stack(control)
    leaving = ((hull < lower) | (hull > upper)).any(axis=(0, 2))
    degree, at = len(hull) - 1, np.flatnonzero(leaving)
    weights = np.stack([math.comb(degree, k) * _SHARES**k * (1 - _SHARES) ** (degree - k) for k in range(degree + 1)])
    for piece in at.tolist():
        stamps = times_ns[piece] + (_SHARES * (times_ns[piece + 1] - times_ns[piece])).astype(np.int64)
        _check_inside(np.einsum("ks,kj->sj", weights, hull[:, piece]), stamps, joints, lower, upper)


def _check_inside(
    positions: Vector, times_ns: NDArray[np.int64], joints: Sequence[str], lower: Vector, upper: Vector
) -> None:
    """Refuse positions, shape (N, J), that are not within limits. Written so that NaN is outside."""
    inside = (positions >= lower) & (positions <= upper)
    if inside.all():
        return
    beyond = np.where(inside, 0.0, np.maximum(lower - positions, positions - upper))
    row, joint = np.unravel_index(int(np.nan_to_num(beyond, nan=np.inf).argmax()), beyond.shape)
    raise GoalRejected(
        f"the trajectory leads {joints[int(joint)]} to {positions[row, joint]:.6g} rad "
        f"{(times_ns[row] - times_ns[0]) / 1e9:.3f} s after its start, outside its limits {lower[joint]:.6g} to "
        f"{upper[joint]:.6g}"
    )


def _order(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Index in `names` of each of `joints`."""
    if sorted(names) != sorted(joints):
        raise GoalRejected(f"joint_names must be, in any order, {', '.join(joints)}; got {', '.join(names) or 'none'}")
    if len(set(names)) < len(names):
        raise GoalRejected(f"joint_names is {', '.join(names)}; it must have each joint once")
    return [names.index(joint) for joint in joints]


def _times(points: Sequence[JointTrajectoryPoint]) -> NDArray[np.int64]:
    previous = -1
    for index, point in enumerate(points):
        time_ns = point.time_from_start_ns
        if not 0 <= time_ns < 2**62:
            raise GoalRejected(f"point {index} has time_from_start_ns {time_ns}; it must be from 0 on")
        if time_ns <= previous:
            raise GoalRejected(f"point {index} is at {time_ns} ns, not after the point before it at {previous} ns")
        previous = time_ns
    if previous == 0:
        raise GoalRejected("the last point is at time 0, which leaves no time to reach it")
    return np.array([point.time_from_start_ns for point in points], dtype=np.int64)


def _field(rows: Sequence[Vector], name: str, order: Sequence[int]) -> Vector | None:
    """A field of all points in the executor's order, shape (N, J); None if no point has it."""
    present = [row.size > 0 for row in rows]  # in ROS, an empty list means that the field is missing
    if not any(present):
        return None
    if not all(present):
        raise GoalRejected(
            f"point {present.index(False)} has no {name} but point {present.index(True)} has; all or none must"
        )
    for index, row in enumerate(rows):
        if row.shape != (len(order),):
            raise GoalRejected(f"point {index} has {name} {row.tolist()}; it must be a list of {len(order)} numbers")
    values = np.stack(rows)
    wrong = ~(np.abs(values) <= _LARGEST)  # so that NaN is wrong
    if wrong.any():
        index, joint = np.argwhere(wrong)[0]
        fault = f"point {index} has {values[index, joint]:g} among its {name}"
        raise GoalRejected(f"{fault}; each must be a finite number, up to {_LARGEST:g}")
    return values[:, order]


def _tolerance(value: float | Mapping[str, float], name: str, default: float, joints: Sequence[str]) -> Vector:
    """Tolerance of each joint [rad], shape (J,); 0: not checked."""
    by_joint = value if isinstance(value, Mapping) else dict.fromkeys(joints, value)
    for joint in by_joint:
        if joint not in joints:
            raise GoalRejected(f"{name} names {joint!r}, which is not a joint here; the joints are {', '.join(joints)}")
    return np.array([_setting(by_joint.get(joint, 0), default, name, _WIDEST_RAD) for joint in joints])


def _setting(value: float, default: float, name: str, highest: float) -> float:
    """A setting; 0 means the default, -1 none (returned as 0)."""
    if not math.isfinite(value) or (value < 0 and value != -1):
        raise GoalRejected(f"{name} is {value!r}; it must be above 0, or 0 for the default, or -1 for none")
    if value > highest:
        raise GoalRejected(f"{name} is {value!r}; it must be at most {highest:g}")
    return default if value == 0 else max(value, 0.0)
