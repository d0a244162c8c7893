"""Joint trajectories of segments from rest to rest, within velocity and acceleration limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Vector

SHORTEST_S = 1e-3
"""Duration of a segment that hardly moves."""

# Greatest velocity and acceleration of the minimum-jerk motion that covers 1 in a second: s = u^3 (10 - 15 u + 6 u^2).
_VELOCITY = 15 / 8
_ACCELERATION = 10 / np.sqrt(3)


type Expectation = Callable[[Vector, Vector], bool]
"""Measured joints [rad], shape (J,), and the scene's ground truth, shape (V,) -> whether the plan still holds."""


def anything(state: Vector, scene: Vector) -> bool:
    """Expect nothing."""
    return True


@attrs.frozen(eq=False)
class Segment:
    """A straight motion from rest at `start` to rest at `end`, both shape (J,) [rad], over `duration_s`."""

    name: str
    start: Vector
    end: Vector
    duration_s: float
    clear: bool = False
    """Whether it ends clear of all objects, so that a new plan can begin there."""
    expects: Expectation = anything
    """Must hold during the segment; otherwise the expert replans."""


@attrs.frozen(eq=False)
class Limits:
    """Joint limits: velocity [rad/s] and acceleration [rad/s^2], each shape (J,)."""

    velocity: Vector
    acceleration: Vector


def duration(start: Vector, end: Vector, limits: Limits) -> float:
    """The shortest duration of a segment [s]."""
    way = np.abs(end - start)
    by_velocity = float(np.max(_VELOCITY * way / limits.velocity))
    by_acceleration = float(np.sqrt(np.max(_ACCELERATION * way / limits.acceleration)))
    return max(SHORTEST_S, by_velocity, by_acceleration)


class Trajectory:
    """Consecutive segments; holds the first position before, and the last one after.

    Args:
        segments: at least one; each begins where the previous one ends.
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        self.segments = tuple(segments)
        self.ends_s = np.cumsum([segment.duration_s for segment in segments])
        """When each segment ends [s], shape (S,)."""
        self._durations_s = np.array([segment.duration_s for segment in segments])
        self._start = np.stack([segment.start for segment in segments])
        self._end = np.stack([segment.end for segment in segments])

    def index(self, times_s: Vector) -> NDArray[np.intp]:
        """Index of the segment at each of `times_s` [s], shape (N,); the last one for later times."""
        return np.minimum(np.searchsorted(self.ends_s, times_s), len(self.segments) - 1)

    def at(self, times_s: Vector) -> Vector:
        """Positions [rad], shape (N, J), at times since the beginning [s], shape (N,)."""
        i = self.index(times_s)
        begins_s = self.ends_s[i] - self._durations_s[i]
        u = np.clip((times_s - begins_s) / self._durations_s[i], 0.0, 1.0)[:, None]
        s = u**3 * (10 - 15 * u + 6 * u**2)
        positions: Vector = self._start[i] + s * (self._end[i] - self._start[i])
        return positions
