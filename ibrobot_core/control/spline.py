"""Splines through timed points: linear, cubic or quintic, depending on the derivatives given."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.robot import Vector
from ibrobot_core.units import NS_PER_S

_TAPS = 16
"""Points used on each side for a velocity; points further away would change it by a billionth."""
_RATIO = 3**0.5 - 2
_KERNEL = 3 * _RATIO ** np.abs(np.arange(-_TAPS, _TAPS + 1)) / (2 * 3**0.5)

Sample = tuple[Vector, Vector, Vector]
"""Position [rad], velocity [rad/s] and acceleration [rad/s^2], each shape (J,)."""


def smooth_velocities(positions: Vector, step_s: float) -> Vector:
    """Velocities [rad/s], shape (N, J), that give a cubic spline continuous accelerations.

    The spline starts with zero acceleration and ends at rest.

    Args:
        positions: [rad], shape (N, J), N >= 2.
        step_s: time between points [s].
    """
    # m[i-1] + 4 m[i] + m[i+1] = 3 (p[i+1] - p[i-1]) for the velocities m, on positions extended without end: mirrored
    # at the end, and with opposite sign at the beginning. The kernel is the inverse.
    last = len(positions) - 1
    phase = np.arange(-_TAPS - 1, last + _TAPS + 2) % (4 * last)
    half = phase % (2 * last)
    rows = positions[np.minimum(half, 2 * last - half)] - positions[0]
    rows[phase >= 2 * last] *= -1.0
    rises = rows[2:] - rows[:-2]
    result: Vector = np.lib.stride_tricks.sliding_window_view(rises, len(_KERNEL), axis=0) @ _KERNEL / step_s
    return result


class Spline:
    """A curve through every point with the given derivatives, which are continuous.

    Positions alone give straight lines, velocities cubic pieces, and accelerations quintic pieces.

    Args:
        times_ns: strictly increasing [ns], shape (N,), N >= 2.
        positions: [rad], shape (N, J).
        velocities: [rad/s], shape (N, J), or None.
        accelerations: [rad/s^2], shape (N, J), or None; only with velocities.
    """

    def __init__(
        self,
        times_ns: NDArray[np.int64],
        positions: Vector,
        velocities: Vector | None = None,
        accelerations: Vector | None = None,
    ) -> None:
        self._times_ns = times_ns
        self._last = positions[-1]
        self._length_s = np.diff(times_ns) / NS_PER_S
        # Each piece is a polynomial in s = 0..1 over its own length.
        length = self._length_s[:, np.newaxis]
        start, rise = positions[:-1], np.diff(positions, axis=0)
        if velocities is None:
            pieces = [start, rise]
        elif accelerations is None:
            v0, v1 = velocities[:-1] * length, velocities[1:] * length
            pieces = [start, v0, 3 * rise - 2 * v0 - v1, v0 + v1 - 2 * rise]
        else:
            v0, v1 = velocities[:-1] * length, velocities[1:] * length
            a0, a1 = accelerations[:-1] * length**2, accelerations[1:] * length**2
            pieces = [
                start,
                v0,
                a0 / 2,
                10 * rise - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1,
                -15 * rise + 8 * v0 + 7 * v1 + 1.5 * a0 - a1,
                6 * rise - 3 * (v0 + v1) + 0.5 * (a1 - a0),
            ]
        self._coefficients = np.stack(pieces)

    @property
    def end_ns(self) -> int:
        """Time of the last point [ns]."""
        return int(self._times_ns[-1])

    def at(self, time_ns: int) -> Sample:
        """The sample at `time_ns` [ns]; the start of the spline before it, the last point at rest after it."""
        if time_ns >= self.end_ns:
            return self._last.copy(), np.zeros_like(self._last), np.zeros_like(self._last)
        time_ns = max(time_ns, int(self._times_ns[0]))
        piece = int(np.searchsorted(self._times_ns, time_ns, side="right")) - 1
        length_s = float(self._length_s[piece])
        s = (time_ns - int(self._times_ns[piece])) / NS_PER_S / length_s
        position = np.zeros_like(self._last)
        velocity = np.zeros_like(self._last)
        half_acceleration = np.zeros_like(self._last)
        for coefficient in self._coefficients[::-1, piece]:
            half_acceleration = half_acceleration * s + velocity
            velocity = velocity * s + position
            position = position * s + coefficient
        return position, velocity / length_s, 2 * half_acceleration / length_s**2
