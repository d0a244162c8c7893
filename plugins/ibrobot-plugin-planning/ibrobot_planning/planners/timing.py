"""Time along a path: as fast as velocity and acceleration limits allow, then smoothed to bounded jerk.

1. Corners of the polyline become parabolas, so that the joints need not stop there.
2. The fastest speed along the path follows from a backward and a forward pass over a grid of it (reachability analysis;
   Pham and Pham, "A new approach to time-optimal path parameterization based on reachability analysis", 2018).
3. A moving average over time bounds the jerk. The average of positions, velocities and accelerations within limits is
   within the same limits, but leaves the path a little: the caller checks the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, cached_property
from itertools import pairwise

import attrs
import numpy as np

from ibrobot_core.api import Header, JointTrajectory, JointTrajectoryPoint, PlanningError, Vector, ns, seconds

_GRID = 0.02
"""Greatest distance [rad] between grid points on straight parts."""
_BLEND_POINTS = 8
"""Grid intervals in a blend."""
_SAMPLE_S = 0.001
"""Time between samples of the motion before it is averaged."""
CHECK_S = 0.001
"""Time between checks of a timed motion for contacts [s]."""
LONGEST_S = 300.0
"""Longest motion: motions are computed, checked and sent in samples."""
_STILL = 1e-9
"""Shorter segments [rad] are skipped."""
_PEAKS = 20
"""Samples between two points, for the maximum velocity and acceleration."""
_EASED = 2e-3
"""Reduction of the limits, for the rounding of samples."""


@attrs.frozen(eq=False, slots=False)
class Motion:
    """Joint positions over time, from rest to rest."""

    times: Vector
    """[s], shape (N,)."""
    positions: Vector
    """[rad], shape (N, J)."""
    velocities: Vector
    """[rad/s], shape (N, J)."""
    accelerations: Vector
    """[rad/s^2], shape (N, J)."""

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.times[-1])

    @property
    def jerk(self) -> float:
        """Maximum rate of change of any joint's acceleration between points [rad/s^3]."""
        steps = np.diff(self.times)[:, None]
        return float(np.abs(np.diff(self.accelerations, axis=0) / steps).max(initial=0.0))

    def slowed(self, factor: float) -> Motion:
        """The same motion in `factor` times its time."""
        return Motion(
            self.times * factor, self.positions, self.velocities / factor, self.accelerations / (factor * factor)
        )

    def sampled(self, step: float, begin: float = 0.0, end: float = math.inf) -> Vector:
        """Positions, velocities and accelerations of the quintic through the points, as an executor follows it.

        Args:
            step: time between samples [s].
            begin: time of the first sample [s].
            end: time of the last sample, if the motion is not over before [s].

        Returns:
            Shape (3, M, J), the end included.
        """
        end = min(end, self.duration)
        times = np.append(np.arange(min(begin, end), end, step), end)
        at = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        h = np.diff(self.times)[at][:, None]
        u = (times - self.times[at])[:, None] / h
        return np.stack(evaluated(self._quintics[:, at], u, h))

    def at(self, time: float) -> Vector:
        """Position, velocity and acceleration at a time [s] within the motion, shape (3, J)."""
        at = min(int(np.searchsorted(self.times, time, side="right")), len(self.times) - 1) - 1
        h = np.diff(self.times)[at : at + 1, None]
        u = (time - self.times[at]) / h
        return np.stack(evaluated(self._quintics[:, at : at + 1], u, h))[:, 0]

    def positions_within(self, step: float) -> Vector:
        """Positions of the quintic at most `step` [s] apart, shape (M, J), all points among them."""
        number = int(np.ceil(np.diff(self.times).max() / step - 1e-6))
        between = _powers(number)[0] @ self._quintics.reshape(6, -1)
        joints = self.positions.shape[1]
        inner = between.reshape(number, -1, joints).swapaxes(0, 1).reshape(-1, joints)
        return np.concatenate([inner, self.positions[-1:]])

    @property
    def peaks(self) -> tuple[Vector, Vector]:
        """Maximum velocity [rad/s] and acceleration [rad/s^2] of each joint between the points, both shape (J,)."""
        steps = np.diff(self.times)[:, None]
        _, speeds, rates = _powers(_PEAKS)
        flat = self._quintics.reshape(6, -1)
        shape = _PEAKS, len(steps), self.positions.shape[1]
        return (
            (np.abs(speeds @ flat).reshape(shape).max(axis=0) / steps).max(axis=0),
            (np.abs(rates @ flat).reshape(shape).max(axis=0) / (steps * steps)).max(axis=0),
        )

    @cached_property
    def _quintics(self) -> Vector:
        """Coefficients of the positions between points, by powers of the share of the time, shape (6, N - 1, J)."""
        fields = self.positions, self.velocities, self.accelerations
        begins, ends = [each[:-1] for each in fields], [each[1:] for each in fields]
        return quintics(np.diff(self.times)[:, None], begins, ends)


def quintics(h: Vector, begins: Sequence[Vector], ends: Sequence[Vector]) -> Vector:
    """Coefficients of positions by powers of the share of the time, shape (6, N, J).

    Args:
        h: durations [s], shape (N, 1).
        begins: positions, velocities and accelerations at their begin, each shape (N, J).
        ends: the same at their end.
    """
    way = ends[0] - begins[0]
    v0, v1 = begins[1] * h, ends[1] * h
    a0, a1 = begins[2] * (h * h), ends[2] * (h * h)
    c3 = 10 * way - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1
    c4 = -15 * way + 8 * v0 + 7 * v1 + 1.5 * a0 - a1
    c5 = 6 * way - 3 * v0 - 3 * v1 - 0.5 * a0 + 0.5 * a1
    return np.stack([begins[0], v0, a0 / 2, c3, c4, c5])


def evaluated(coefficients: Vector, u: Vector, h: Vector) -> tuple[Vector, Vector, Vector]:
    """Positions, velocities and accelerations of quintics at shares `u` of their durations `h` [s], shape (N, 1)."""
    c0, c1, c2, c3, c4, c5 = coefficients
    return (
        c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5)))),
        (c1 + u * (2 * c2 + u * (3 * c3 + u * (4 * c4 + u * 5 * c5)))) / h,
        (2 * c2 + u * (6 * c3 + u * (12 * c4 + u * 20 * c5))) / (h * h),
    )


def resting(q: Vector, duration: float) -> Motion:
    """Rest at `q` [rad], shape (J,), for a duration [s]."""
    rest = np.zeros((2, len(q)))
    return Motion(np.array([0.0, duration]), np.array([q, q]), rest, rest)


def motion_of(trajectory: JointTrajectory) -> Motion | None:
    """A trajectory as a motion; None if it lacks velocities or accelerations."""
    points = trajectory.points
    if len(points) < 2 or not all(point.velocities.size and point.accelerations.size for point in points):
        return None
    return Motion(
        np.array([seconds(point.time_from_start_ns) for point in points]),
        np.array([point.positions for point in points]),
        np.array([point.velocities for point in points]),
        np.array([point.accelerations for point in points]),
    )


def trajectory_of(made: Motion, joints: tuple[str, ...], stamp_ns: int) -> JointTrajectory:
    """A motion as a message."""
    rows = zip(made.times.tolist(), made.positions, made.velocities, made.accelerations, strict=True)
    points = tuple(JointTrajectoryPoint(ns(time), *row) for time, *row in rows)
    return JointTrajectory(Header(stamp_ns=stamp_ns), joints, points)


@cache
def _powers(number: int) -> tuple[Vector, Vector, Vector]:
    """Factors of a quintic's coefficients at shares 0, 1 / number, …, for its value and two derivatives."""
    u = (np.arange(number) / number)[:, None]
    n = np.arange(6)
    return (
        u**n,
        n * u ** np.maximum(n - 1, 0),
        n * (n - 1) * u ** np.maximum(n - 2, 0),
    )


def timed(
    path: Vector, max_velocity: Vector, max_acceleration: Vector, *, blends: Vector, window: float, step: float
) -> Motion:
    """The fastest motion along a path within the limits, from rest to rest.

    Args:
        path: waypoints [rad], shape (N, J), N at least 1.
        max_velocity: [rad/s], shape (J,).
        max_acceleration: [rad/s^2], shape (J,).
        blends: how far before and after each inner waypoint the motion may leave the path [rad], shape (N - 2,); 0
            stops there.
        window: width of the moving average [s]: the jerk stays below 2 max_acceleration / window.
        step: greatest time between points [s]; less if the window is narrow.

    Returns:
        From the first to the last waypoint, both at rest.

    Raises:
        PlanningError: if the limits are so low that the motion takes longer than `LONGEST_S`.
    """
    path, blends = _without_repeats(np.asarray(path, dtype=float), blends)
    if len(path) == 1:
        return resting(path[0], step)
    samples = max(round(window / _SAMPLE_S), 4)
    step = min(step, samples * _SAMPLE_S / 2)
    max_velocity, max_acceleration = (1 - _EASED) * max_velocity, (1 - _EASED) * max_acceleration
    stops = [0, *(np.flatnonzero(blends <= _STILL) + 1).tolist(), len(path) - 1]
    parts = [
        _fastest(path[first : last + 1], blends[first : last - 1], max_velocity, max_acceleration)
        for first, last in pairwise(stops)
    ]
    # Rest for the width of the average, which would otherwise cut a corner at which the motion stops.
    rested = [np.concatenate([part, np.repeat(part[-1:], samples, axis=0)]) for part in parts]
    motion = _averaged(np.concatenate([np.repeat(path[:1], samples, axis=0), *rested]), samples, step)
    # Between its points the quintic exceeds them a little.
    velocities, accelerations = motion.peaks
    beyond = np.maximum(velocities / max_velocity, np.sqrt(accelerations / max_acceleration)).max()
    return motion.slowed(max(float(beyond), 1.0))


def _without_repeats(path: Vector, blends: Vector) -> tuple[Vector, Vector]:
    """The path without repeated waypoints, and the blends of the others."""
    blends = np.concatenate([[0.0], blends, [0.0]])[: len(path)]
    kept = [0]
    for i in range(1, len(path)):
        if np.linalg.norm(path[i] - path[kept[-1]]) > _STILL:
            kept.append(i)
    if len(kept) > 1:
        kept[-1] = len(path) - 1
    return path[kept], blends[kept][1:-1]


def check_duration(duration: float) -> None:
    """Check a motion's duration [s] before it is computed in samples.

    Raises:
        PlanningError: if it is above `LONGEST_S`.
    """
    if not duration <= LONGEST_S:  # written so that NaN fails it
        raise PlanningError(
            f"the motion would take {duration:.3g} s, at most {LONGEST_S:g} s are planned: "
            "raise velocity_scaling or acceleration_scaling"
        )


def _fastest(path: Vector, blends: Vector, max_velocity: Vector, max_acceleration: Vector) -> Vector:
    """Positions [rad] every millisecond of the fastest motion along a path with parabolic corners, shape (N, J)."""
    s, positions, slopes, bends = _grid(path, blends)
    squared = _speeds(s, slopes, bends, max_velocity, max_acceleration)
    speeds = np.sqrt(squared)
    stamps = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (speeds[1:] + speeds[:-1]))])
    # Slow down by the excess between grid points.
    rates = np.diff(squared) / (2 * np.diff(s))
    begins, ends = (
        slopes[which] * rates[:, None] + bends * squared[which, None] for which in (slice(-1), slice(1, None))
    )
    slower = np.sqrt(max(1.0, (np.abs([begins, ends]) / max_acceleration).max()))
    slower = max(slower, (np.abs(slopes) * speeds[:, None] / max_velocity).max())
    duration = float(slower * stamps[-1])
    check_duration(duration)
    times = np.append(np.arange(0.0, duration, _SAMPLE_S), duration) / slower
    at = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(s) - 2)
    t = times - stamps[at]
    ahead = speeds[at] * t + rates[at] * t * t / 2
    return np.asarray(positions[at] + slopes[at] * ahead[:, None] + bends[at] * (ahead * ahead / 2)[:, None])


def _grid(path: Vector, blends: Vector) -> tuple[Vector, Vector, Vector, Vector]:
    """The path over its parameter s: grid [rad], positions, slopes dq/ds, and d2q/ds2 of each interval.

    On a straight part, s is the distance. A corner P between directions a and b is the parabola with tangents a and b
    from P - l a to P + l b, on which the slope changes evenly while s grows by 2 l.
    """
    ways = np.diff(path, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    directions = ways / lengths[:, None]
    radii = np.concatenate([[0.0], np.minimum(blends, np.minimum(lengths[:-1], lengths[1:]) / 2), [0.0]])
    steps, bends = [], []
    slope = [directions[:1]]
    for i, direction in enumerate(directions):
        straight = lengths[i] - radii[i] - radii[i + 1]
        if straight > _STILL:
            number = max(int(np.ceil(straight / _GRID)), 4)
            steps.append(np.full(number, straight / number))
            bends.append(np.zeros((number, path.shape[1])))
            slope.append(np.repeat(direction[None], number, axis=0))
        if i + 1 < len(directions):
            after, width = directions[i + 1], 2 * radii[i + 1]
            steps.append(np.full(_BLEND_POINTS, width / _BLEND_POINTS))
            bends.append(np.repeat([(after - direction) / width], _BLEND_POINTS, axis=0))
            shares = np.arange(1, _BLEND_POINTS + 1)[:, None] / _BLEND_POINTS
            slope.append((1 - shares) * direction + shares * after)
    step, bend, slopes = np.concatenate(steps), np.concatenate(bends), np.concatenate(slope)
    moved = slopes[:-1] * step[:, None] + bend * (step * step / 2)[:, None]
    positions = path[0] + np.concatenate([np.zeros((1, path.shape[1])), np.cumsum(moved, axis=0)])
    return np.concatenate([[0.0], np.cumsum(step)]), positions, slopes, bend


def _speeds(s: Vector, slopes: Vector, bends: Vector, max_velocity: Vector, max_acceleration: Vector) -> Vector:
    """Squares of the maximum speeds ds/dt at the grid points.

    With x = (ds/dt)^2 and u = d2s/dt2, each joint bounds |slope u + bend x| by its acceleration, and on an interval
    x changes by 2 u ds. The bounds hold at both ends of an interval: at its end, where the slope is slope', they are
    |slope' u + bend (x + 2 u ds)|.
    """
    count = len(s)
    width = 2 * np.diff(s)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ceiling = np.min((max_velocity / np.abs(slopes)) ** 2, axis=1)
        # u lies between the lines -h - k x and h - k x of each joint.
        factors = np.concatenate([slopes[:-1], slopes[1:] + bends * width[:, None]], axis=1)
        bent = np.concatenate([bends, bends], axis=1)
        most = np.concatenate([max_acceleration, max_acceleration])
        h = most / np.abs(factors)
        k = bent / factors
        # A joint that does not move here bounds only x.
        still = np.abs(factors) < 1e-9
        flat = np.where(still & (bent != 0), most / np.abs(bent), np.inf).min(axis=1)
        h, k = np.where(still, np.inf, h), np.where(still, 0.0, k)
        # The lower line of one joint meets the upper line of another.
        apart = k[:, :, None] - k[:, None, :]
        meets = np.where(apart > 1e-12, (h[:, :, None] + h[:, None, :]) / apart, np.inf)
    ceiling[:-1] = np.minimum(ceiling[:-1], np.minimum(flat, meets.min(axis=(1, 2))))
    ceiling[0] = ceiling[-1] = 0.0
    # Both passes take one interval at a time: lists of floats are faster here than arrays of five.
    least = h.min(axis=1).tolist()
    lines = [
        list(zip(hs, ks, strict=True)) if any(ks) else [(lowest, 0.0)]
        for lowest, hs, ks in zip(least, h.tolist(), k.tolist(), strict=True)
    ]
    widths, bound = width.tolist(), ceiling.tolist()
    for i in range(count - 2, -1, -1):
        # The strongest braking must reach the next bound: -h - k x <= (next - x) / width.
        after, w = bound[i + 1], widths[i]
        for hi, ki in lines[i]:
            rest = 1 - ki * w
            if rest > 0 and hi * w + after < bound[i] * rest:
                bound[i] = (hi * w + after) / rest
    x = [0.0] * count
    for i in range(count - 1):
        strongest = min(hi - ki * x[i] for hi, ki in lines[i])
        x[i + 1] = max(min(bound[i + 1], x[i] + widths[i] * strongest), 0.0)
    return np.array(x)


def _averaged(positions: Vector, samples: int, step: float) -> Motion:
    """The moving average over `samples` samples of positions that begin and end with as many at rest."""
    window = samples * _SAMPLE_S
    velocities = np.gradient(positions, _SAMPLE_S, axis=0)
    velocities[0] = velocities[-1] = 0.0
    # Integral by the trapezium rule with its first correction: the samples are exact, the integral nearly.
    middles = (positions[1:] + positions[:-1]) / 2 * _SAMPLE_S - np.diff(velocities, axis=0) * (_SAMPLE_S**2 / 12)
    integral = np.concatenate([np.zeros((1, positions.shape[1])), np.cumsum(middles, axis=0)])
    averaged = (integral[samples:] - integral[:-samples]) / window
    speed = (positions[samples:] - positions[:-samples]) / window
    rate = (velocities[samples:] - velocities[:-samples]) / window
    averaged[0], averaged[-1] = positions[0], positions[-1]
    speed[0] = speed[-1] = rate[0] = rate[-1] = 0.0
    every = max(round(step / _SAMPLE_S), 1)
    kept = np.arange(0, len(averaged), every)
    if kept[-1] != len(averaged) - 1:
        kept = np.append(kept, len(averaged) - 1)
    return Motion(np.asarray(kept * _SAMPLE_S), averaged[kept], speed[kept], rate[kept])
