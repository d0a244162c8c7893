"""Blends from one motion into the next: the first slows down along its path while the next one already begins.

A replaced motion brakes along its own path, which is known to be free. The next motion is planned from where the arm
comes to rest, and added to the braking motion as early as limits and obstacles permit. At worst it begins when the arm
stands.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_planning.planners.timing import Motion

STEP_S = 0.01
"""Time between the points of the motions made here."""
_SAMPLE_S = 0.001
_SHARE = 0.5
"""Share of the acceleration limits that braking uses: the rest lets the next motion begin at once."""
_JERK = 400.0
"""Jerk of the fastest joint when braking begins and ends [rad/s^3]."""
_OVERLAPS = 6
"""Number of times at which the next motion may begin while the arm brakes."""
_SLOWED = (1.0, 1.2, 1.4, 1.8)
"""Factors by which the next motion may be slowed to begin earlier."""
_GLANCE = 5
"""Every fifth sample is checked before all of them."""
_ROUNDING = 1e-3
"""Allowed excess of the limits, as a share of them."""


@attrs.frozen(eq=False)
class Limits:
    """Limits of the joints, each shape (J,)."""

    lower: Vector
    """[rad]."""
    upper: Vector
    """[rad]."""
    velocity: Vector
    """[rad/s]."""
    acceleration: Vector
    """[rad/s^2]."""

    def hold_at(self, samples: Vector) -> bool:
        """Whether samples of a motion, shape (3, N, J), are within the limits; it may begin outside the positions."""
        positions, velocities, accelerations = samples
        lower, upper = np.minimum(self.lower, positions[0]), np.maximum(self.upper, positions[0])
        more = 1 + _ROUNDING
        return bool(
            (positions >= lower - _ROUNDING).all()
            and (positions <= upper + _ROUNDING).all()
            and (np.abs(velocities) <= more * self.velocity).all()
            and (np.abs(accelerations) <= more * self.acceleration).all()
        )


def braking(old: Motion, begin_s: float, brake_s: float, acceleration: Vector) -> Motion:
    """The rest of a motion from `begin_s` [s] on, which brakes along its path from `brake_s` [s] on.

    Args:
        old: the motion.
        begin_s: time at which the result begins.
        brake_s: time at which braking begins; not before `begin_s`.
        acceleration: limits of the joints [rad/s^2], shape (J,).
    """
    samples = _samples(old)
    phase, rate, change = begin_s, 1.0, 0.0
    rows = []
    while True:
        i = min(int(phase / _SAMPLE_S), samples.shape[1] - 1)
        position, velocity, moved = samples[:, i]
        ahead = phase - i * _SAMPLE_S
        position, velocity = position + ahead * (velocity + ahead * moved / 2), velocity + ahead * moved
        rows.append((position, velocity * rate, velocity * change + moved * rate**2))
        if phase >= old.duration or rate <= 0:
            break
        if phase >= brake_s:
            # Acceleration of a joint: velocity * change + moved * rate^2.
            speed = np.maximum(np.abs(velocity), 1e-9)
            left = (_SHARE * acceleration + np.sign(velocity) * moved * rate**2) / speed
            jerk = _JERK / max(float(speed.max()), 0.1)
            strongest = max(float((-left).max()), -np.sqrt(2 * jerk * rate), change - jerk * _SAMPLE_S)
            change = min(strongest, 0.0)
        after = max(rate + change * _SAMPLE_S, 0.0)
        phase = min(phase + (rate + after) / 2 * _SAMPLE_S, old.duration)
        rate = after
    made = np.array(rows)
    made[-1, 1:] = 0.0
    return _every(made, STEP_S)


def joined(old: Motion, new: Motion, begin_s: float, limits: Limits) -> Iterator[Motion]:
    """Blends from one motion into another, the shortest first; each begins where `old` is at `begin_s` [s].

    Args:
        old: comes to rest where `new` begins.
        new: from rest to rest.
        begin_s: time of `old`, before its end.
        limits: limits of the result.
    """
    rest = _samples(old)[:, round(begin_s / _SAMPLE_S) :]
    slowed = {factor: _samples(new, factor) for factor in _SLOWED}
    starts = np.linspace(0, rest.shape[1] - 1, _OVERLAPS + 1).astype(int).tolist()
    ways = [(start, slowed[factor]) for start, factor in product(starts, _SLOWED)]
    for start, following in sorted(ways, key=lambda way: way[0] + way[1].shape[1]):
        rows = _sum(rest, following, start)
        # Executors refuse a motion that does not end at rest, even if only by rounding.
        rows[1:, -1] = 0.0
        if limits.hold_at(rows[:, ::_GLANCE]):
            candidate = _every(rows.transpose(1, 0, 2), STEP_S)
            if limits.hold_at(candidate.sampled(_SAMPLE_S)):
                yield candidate


def _sum(rest: Vector, following: Vector, start: int) -> Vector:
    """Samples of a motion, with the displacement of a second motion added from sample `start` on, shape (3, N, J)."""
    end = start + following.shape[1]
    rows = np.zeros((3, max(rest.shape[1], end), rest.shape[2]))
    rows[:, : rest.shape[1]] = rest
    rows[0, rest.shape[1] :] = rest[0, -1]
    rows[0, start:end] += following[0] - following[0, 0]
    rows[1:, start:end] += following[1:]
    rows[0, end:] += following[0, -1] - following[0, 0]
    return rows


@lru_cache(maxsize=16)
def _samples(motion: Motion, slower: float = 1.0) -> Vector:
    """Samples of a motion in `slower` times its time, shape (3, N, J); cached, since blends are tried at every tick."""
    return motion.slowed(slower).sampled(_SAMPLE_S)


def cut(whole: Motion, end_s: float) -> Motion:
    """The beginning of a motion, up to its last point before `end_s` [s], and at least its first two points."""
    number = max(int(np.searchsorted(whole.times, end_s, side="right")), 2)
    return Motion(
        whole.times[:number], whole.positions[:number], whole.velocities[:number], whole.accelerations[:number]
    )


def _every(rows: Vector, step_s: float) -> Motion:
    """A motion through samples of `rows`, shape (N, 3, J), that are `step_s` [s] apart, and through the last."""
    every, last = round(step_s / _SAMPLE_S), max(len(rows) - 1, 1)
    kept = np.append(np.arange(0, last, every), last)
    rows = rows[np.minimum(kept, len(rows) - 1)]
    return Motion(kept * _SAMPLE_S, rows[:, 0], rows[:, 1], rows[:, 2])
