"""Joint trajectories made of segments, each from rest to rest, timed within velocity and acceleration limits."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.robot import Vector

SHORTEST_S = 1e-3

_U = np.linspace(0.0, 1.0, 101)[:, None]
# Minimum-jerk timing: fraction of the way at fraction of the time, and its derivatives.
_S = _U**3 * (10 - 15 * _U + 6 * _U**2)
_DS = 30 * _U**2 * (1 - _U) ** 2
_DDS = 60 * _U * (1 - 3 * _U + 2 * _U**2)


@attrs.frozen(eq=False)
class Segment:
    """A motion from rest at `start` to rest at `end`, both shape (J,) [rad], over `duration_s`.

    The way is a parabola in joint space: halfway it is `bow` [rad], shape (J,), away from the straight line.
    """

    name: str
    start: Vector
    end: Vector
    bow: Vector
    duration_s: float


@attrs.frozen(eq=False)
class Limits:
    """What no joint exceeds: velocity [rad/s] and acceleration [rad/s^2], each shape (J,)."""

    velocity: Vector
    acceleration: Vector


def move(name: str, start: Vector, end: Vector, limits: Limits, *, via: Vector | None = None) -> Segment:
    """The fastest segment from `start` to `end`, through `via` halfway where given; all shape (J,) [rad]."""
    # A joint that goes straight on to its end never leaves the range between the two, which is within its limits.
    most = np.abs(end - start) / 4
    bow = np.zeros_like(start) if via is None else np.clip(via - (start + end) / 2, -most, most)
    slope = (end - start) + 4 * bow * (1 - 2 * _S)
    velocity = np.abs(slope * _DS) / limits.velocity
    acceleration = np.abs(slope * _DDS - 8 * bow * _DS**2) / limits.acceleration
    # These are for one second; velocity scales with 1 / duration, acceleration with its square.
    return Segment(name, start, end, bow, max(SHORTEST_S, float(velocity.max()), float(np.sqrt(acceleration.max()))))


def rest(name: str, position: Vector, duration_s: float) -> Segment:
    """A segment that stays at `position`, shape (J,) [rad]."""
    return Segment(name, position, position, np.zeros_like(position), duration_s)


class Trajectory:
    """Segments one after another; it holds the first position before, and the last one after.

    Args:
        segments: at least one; each begins where the one before ends.
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        self.segments = tuple(segments)
        self.ends_s = np.cumsum([segment.duration_s for segment in segments])
        """When each segment ends [s], shape (S,)."""
        self._durations_s = np.array([segment.duration_s for segment in segments])
        self._start = np.stack([segment.start for segment in segments])
        self._end = np.stack([segment.end for segment in segments])
        self._bow = np.stack([segment.bow for segment in segments])

    def index(self, times_s: Vector) -> NDArray[np.intp]:
        """Which segment each of `times_s` [s], shape (N,), falls into; the last one for all that is later."""
        return np.minimum(np.searchsorted(self.ends_s, times_s), len(self.segments) - 1)

    def at(self, times_s: Vector) -> Vector:
        """Positions [rad], shape (N, J), at `times_s` since the beginning [s], shape (N,)."""
        i = self.index(times_s)
        begins_s = self.ends_s[i] - self._durations_s[i]
        u = np.clip((times_s - begins_s) / self._durations_s[i], 0.0, 1.0)[:, None]
        s = u**3 * (10 - 15 * u + 6 * u**2)
        positions: Vector = self._start[i] + s * (self._end[i] - self._start[i]) + 4 * s * (1 - s) * self._bow[i]
        return positions
