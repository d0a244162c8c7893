"""Completion of trajectories: from where the robot stands, with velocities and accelerations, within the limits.

Executors follow the points of every trajectory by quintics of positions, velocities and accelerations. Missing
fields are computed here, so that the robot makes exactly the motion that was checked:

- Positions alone: the cubic spline with continuous accelerations, at rest at both ends.
- Positions and velocities: the cubic between two points. Where the acceleration jumps from one cubic to the next, two
  more points close by limit the change to a fraction of a control period.
- A first point not quite where the robot stands: a short motion from rest to rest leads there.
- A first point after time 0: the motion begins where the robot is, and reaches the point at its time.
"""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import GoalRejected, JointTrajectory, PlanCode, PlanningError, Robot, Vector, ns, seconds
from ibrobot_planning.executors.trajectory_goal import Points, check_rates, check_rest, points_of
from ibrobot_planning.planners.timing import LONGEST_S, Motion, evaluated, motion_of, quintics, trajectory_of

START_RAD = 0.01
"""Allowed distance between a point at time 0 and the robot, as in MoveIt."""
MOVING_START_RAD = 0.1
"""The same for a trajectory that takes over from another one, whose point at time 0 is not used."""
MOST_POINTS = 2000
"""Most points of a trajectory from outside: the control process reads them between two ticks."""
_SAME_RAD = 1e-6
"""A start this near to the robot needs no motion to it."""
_MORE = 1.01
"""Allowed excess of the limits of velocity and acceleration, for rounding."""
_BEYOND_RAD = 1e-5
"""Allowed excess of positions, for rounding."""
_MOST_PARTS = 20
"""Most samples within half a control period."""
_JUMP = 1e-3
"""Jumps of the acceleration, as a share of its limit, that need no further points."""
_QUINTIC_SPEED, _QUINTIC_RATE = 1.875, 5.7736
"""Peak velocity and acceleration of a quintic from rest to rest, for a unit of distance in unit time."""


@attrs.frozen(eq=False)
class Start:
    """Where a motion begins: the commanded state of J joints."""

    position: Vector
    """[rad], shape (J,)."""
    velocity: Vector | None = None
    """[rad/s], shape (J,); None at rest."""
    acceleration: Vector | None = None
    """[rad/s^2], shape (J,); None at rest."""
    measured: Vector | None = None
    """Measured positions [rad], shape (J,), from which trajectories may have been planned, too."""


def check_size(trajectory: JointTrajectory) -> None:
    """Refuse a trajectory that costs too much to check and to send.

    Raises:
        PlanningError: with too many points, or too long a duration.
    """
    if len(trajectory.points) > MOST_POINTS:
        raise _invalid(f"the trajectory has {len(trajectory.points)} points; at most {MOST_POINTS} are accepted")
    last_ns = trajectory.points[-1].time_from_start_ns if trajectory.points else 0
    if last_ns > ns(LONGEST_S):
        raise _invalid(f"the trajectory takes {seconds(last_ns):g} s; at most {LONGEST_S:g} s are accepted")


def completed(trajectory: JointTrajectory, start: Start, robot: Robot, period_ns: int) -> JointTrajectory:
    """The motion of a robot that follows a trajectory, with velocities and accelerations in all points.

    Args:
        trajectory: to rest; also from rest if it has a point at time 0 and the robot is at rest.
        start: where its joints are.
        robot: the robot.
        period_ns: control period.

    Returns:
        The trajectory itself if nothing is missing.

    Raises:
        PlanningError: if a number is missing or not finite, or if the trajectory begins away from the robot, does not
            end at rest, or exceeds a limit.
    """
    names = trajectory.joint_names
    order = robot.indices(names)
    try:
        given = points_of(trajectory, names)
        if given.velocities is not None and given.times_ns[0] == 0 and start.velocity is None:
            check_rest(given.velocities[0], "first", names)
        check_rates(given, names, robot.max_velocity[order], robot.max_acceleration[order], _MORE)
    except GoalRejected as error:
        raise _invalid(str(error)) from None
    points = _from_robot(given, start, robot, order, names, period_ns)
    made = motion_of(trajectory)
    if made is None or not _is_whole(made, start):
        made = _smooth(points, start, robot.max_acceleration[order], period_ns)
        trajectory = trajectory_of(made, names, trajectory.header.stamp_ns)
    shortest_s = float(np.diff(points.times_ns).min()) / ns(1.0)
    _check_limits(made, robot, order, names, seconds(period_ns), shortest_s)
    return trajectory


def _is_whole(made: Motion, start: Start) -> bool:
    """Whether a motion begins exactly at `start`, at rest and without acceleration."""
    begins = made.times[0] == 0 and np.abs(made.positions[0] - start.position).max() <= _SAME_RAD
    at_rest = start.velocity is None and not made.velocities[0].any() and not made.accelerations[0].any()
    return bool(begins and at_rest)


def _from_robot(
    points: Points, start: Start, robot: Robot, order: NDArray[np.intp], names: tuple[str, ...], period_ns: int
) -> Points:
    """The points, after a motion from where the robot is to the first one.

    Raises:
        PlanningError: if they begin elsewhere.
    """
    later_ns = 0
    if points.times_ns[0] == 0:
        _check_begin(points.positions[0], start, names)
        away = np.abs(points.positions[0] - start.position)
        if start.velocity is not None or away.max() <= _SAME_RAD:
            points = Points(
                points.times_ns[1:],
                points.positions[1:],
                *(None if field is None else field[1:] for field in (points.velocities, points.accelerations)),
            )
        else:
            fastest, strongest = robot.max_velocity[order], robot.max_acceleration[order]
            lead_s = max(
                float((_QUINTIC_SPEED * away / fastest).max()), float(np.sqrt(_QUINTIC_RATE * away / strongest).max())
            )
            later_ns = max(ns(_MORE * lead_s), 2 * period_ns)
            if points.velocities is None:  # the motion to the first point ends at rest: the spline begins after it
                velocities = _spline_velocities(points.times_ns, points.positions)
                points = attrs.evolve(points, velocities=velocities)
    rest = np.zeros(len(start.position))
    firsts = start.position, rest if start.velocity is None else start.velocity, rest
    if start.acceleration is not None:
        firsts = *firsts[:2], start.acceleration
    fields = points.positions, points.velocities, points.accelerations
    return Points(
        np.concatenate([[0], points.times_ns + later_ns]),
        *(None if field is None else np.vstack([first, field]) for first, field in zip(firsts, fields, strict=True)),  # type: ignore[arg-type]
    )


def _check_begin(first: Vector, start: Start, names: tuple[str, ...]) -> None:
    """Check that a point at time 0 is where the robot is.

    Raises:
        PlanningError: if not.
    """
    away, most = np.abs(first - start.position), START_RAD if start.velocity is None else MOVING_START_RAD
    if start.measured is not None:
        away = np.fmin(away, np.abs(first - start.measured))
    # Written so that NaN fails it.
    if not away.max() <= most:
        joint = int(away.argmax())
        raise PlanningError(
            f"the trajectory begins with {names[joint]} at {first[joint]:.4f} rad, the robot is at"
            f" {start.position[joint]:.4f} rad; at most {most} rad may lie between them",
            PlanCode.START_STATE_INVALID,
        )


def _spline_velocities(times_ns: NDArray[np.int64], positions: Vector, first: Vector | None = None) -> Vector:
    """Velocities [rad/s], shape (N, J), of the cubic spline through the points whose acceleration is continuous.

    It begins with the velocities `first` [rad/s], shape (J,), by default at rest, and ends at rest.
    """
    h = (np.diff(times_ns) / ns(1.0))[:, None]
    slopes = np.diff(positions, axis=0) / h
    velocities = np.zeros_like(positions)
    # h[i] v[i-1] + 2 (h[i-1] + h[i]) v[i] + h[i-1] v[i+1] = 3 (h[i] s[i-1] + h[i-1] s[i]), solved from both ends.
    factors, rests = np.zeros(len(positions)), np.zeros_like(positions)
    if first is not None:
        velocities[0] = rests[0] = first
    for i in range(1, len(positions) - 1):
        before, after = float(h[i - 1, 0]), float(h[i, 0])
        pivot = 2 * (before + after) - after * factors[i - 1]
        factors[i] = before / pivot
        rests[i] = (3 * (after * slopes[i - 1] + before * slopes[i]) - after * rests[i - 1]) / pivot
    for i in range(len(positions) - 2, 0, -1):
        velocities[i] = rests[i] - factors[i] * velocities[i + 1]
    return velocities


def _smooth(points: Points, start: Start, max_acceleration: Vector, period_ns: int) -> Motion:
    """The points as one motion whose acceleration does not jump; it begins with that of `start` and ends without."""
    velocities = points.velocities
    if velocities is None:
        velocities = _spline_velocities(points.times_ns, points.positions, start.velocity)
    left, right = _accelerations(points, velocities)
    none = np.zeros((1, points.positions.shape[1]))
    begins = none if start.acceleration is None else start.acceleration[None]
    before, after = np.concatenate([begins, right]), np.concatenate([left, none])
    means = (before + after) / 2
    means[0], means[-1] = begins[0], 0.0
    jumps = (np.abs(after - before) > _JUMP * max_acceleration).any(axis=1)
    lengths = np.diff(points.times_ns)
    near_ns = np.minimum(lengths, period_ns) // 4
    rows = [(points.times_ns, points.positions, velocities, means)]
    for has_jump, at_ns in ((jumps[:-1], near_ns), (jumps[1:], lengths - near_ns)):
        pieces = np.flatnonzero(has_jump & (near_ns > 0))
        rows.append(_at(points, velocities, left, right, pieces, at_ns[pieces]))
    times, *values = (np.concatenate(columns) for columns in zip(*rows, strict=True))
    kept = np.argsort(times, kind="stable")
    return Motion(times[kept] / ns(1.0), *(column[kept] for column in values))


def _accelerations(points: Points, velocities: Vector) -> tuple[Vector, Vector]:
    """Accelerations at the start and at the end of each piece between points [rad/s^2], both shape (N - 1, J)."""
    if points.accelerations is not None:
        return points.accelerations[:-1], points.accelerations[1:]
    h = (np.diff(points.times_ns) / ns(1.0))[:, None]
    slopes = np.diff(points.positions, axis=0) / h
    v0, v1 = velocities[:-1], velocities[1:]
    return (6 * slopes - 4 * v0 - 2 * v1) / h, (2 * v0 + 4 * v1 - 6 * slopes) / h


def _at(
    points: Points, velocities: Vector, left: Vector, right: Vector, pieces: NDArray[np.intp], at_ns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Vector, Vector, Vector]:
    """Times, positions, velocities and accelerations of the quintics at a time [ns] within each of some pieces."""
    h = (np.diff(points.times_ns)[pieces] / ns(1.0))[:, None]
    begins = points.positions[pieces], velocities[pieces], left[pieces]
    ends = points.positions[pieces + 1], velocities[pieces + 1], right[pieces]
    at = evaluated(quintics(h, begins, ends), (at_ns / ns(1.0))[:, None] / h, h)
    return (points.times_ns[pieces] + at_ns, *at)


def _check_limits(
    made: Motion, robot: Robot, order: NDArray[np.intp], names: tuple[str, ...], period_s: float, shortest_s: float
) -> None:
    """Check positions, velocities and accelerations as the safety layer does: by setpoints a control period apart.

    Args:
        made: the motion.
        robot: the robot.
        order: indices of the joints.
        names: their names.
        period_s: control period.
        shortest_s: least time between two points of the original trajectory.

    Raises:
        PlanningError: for the joint that exceeds a limit most.
    """
    # Setpoints may fall anywhere between the points: sample as densely as the nearest points.
    parts = min(max(math.ceil(period_s / (2 * shortest_s)), 1), _MOST_PARTS)
    step = period_s / 2 / parts
    inner = made.sampled(step)[0]
    rest = np.repeat(inner[-1:], 3 * parts, axis=0)
    before = step * np.arange(-2 * parts, 0)[:, None]
    begins = inner[0] + before * (made.velocities[0] + before * made.accelerations[0] / 2)
    positions = np.concatenate([begins, inner, rest])
    # A motion may begin outside the limits, and lead inwards.
    lower, upper = np.minimum(robot.lower[order], inner[0]), np.maximum(robot.upper[order], inner[0])
    speeds = np.abs(positions[parts:] - positions[:-parts]) / (parts * step)
    middle = positions[2 * parts : -2 * parts]
    changes = np.abs(positions[4 * parts :] - 2 * middle + positions[: -4 * parts]) / period_s**2
    for what, unit, values, limits in (
        ("position", "rad", np.maximum(positions - upper, lower - positions), np.full(len(order), _BEYOND_RAD)),
        ("velocity", "rad/s", speeds, _MORE * robot.max_velocity[order]),
        ("acceleration", "rad/s²", changes, _MORE * robot.max_acceleration[order]),
    ):
        # Written so that NaN fails it.
        if not (values <= limits).all():
            worst, joint = np.unravel_index(int((values / limits).argmax()), values.shape)
            peak, limit = values[worst, joint], limits[joint] / _MORE
            fault = f"a {what} of {peak:.4g} {unit}; its limit is {limit:.4g} {unit}"
            if what == "position":
                fault = f"a position {peak:.4g} rad outside its limits"
            at = min(max(float(worst) - parts, 0) * step, made.duration)
            raise _invalid(f"the trajectory gives {names[int(joint)]} near {at:.3f} s {fault}")


def _invalid(message: str) -> PlanningError:
    return PlanningError(message, PlanCode.INVALID_MOTION_PLAN)
