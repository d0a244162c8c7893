"""The fastest motion from rest to rest along a line, within limits on velocity, acceleration and jerk."""

from __future__ import annotations

import math
from itertools import accumulate


class RestToRest:
    """A symmetric profile of seven phases, each of constant jerk; some have no length.

    Speed rises over three phases (jerk `+j`, 0, `-j`), stays, and falls as it rose. Of the three limits those hold that
    the distance lets the motion reach.

    Args:
        distance: way from rest to rest, above 0.
        max_velocity: greatest speed, above 0.
        max_acceleration: greatest rate of change of speed, above 0.
        max_jerk: greatest rate of change of acceleration, above 0.

    Attributes:
        ends: when each phase ends [s], 7 times.
    """

    def __init__(self, distance: float, max_velocity: float, max_acceleration: float, max_jerk: float) -> None:
        self.distance = distance
        speed = min(max_velocity, _peak_speed(distance, max_acceleration, max_jerk))
        # The acceleration is a trapezium over time, or a triangle where the speed is reached before the limit.
        ramp = min(max_acceleration / max_jerk, math.sqrt(speed / max_jerk))
        plateau = max(speed / (max_jerk * ramp) - ramp, 0.0)
        cruise = max(distance / speed - 2 * ramp - plateau, 0.0)
        self.ends = tuple(accumulate([ramp, plateau, ramp, cruise, ramp, plateau, ramp]))
        self._times = (ramp, plateau, ramp, 0.5 * cruise)
        self._jerks = (max_jerk, 0.0, -max_jerk, 0.0)

    def at(self, time: float) -> tuple[float, float, float]:
        """Way, speed and acceleration at `time` [s], from 0 to the last of `ends`."""
        if 2 * time > self.ends[-1]:
            way, speed, acceleration = self.at(self.ends[-1] - time)
            return self.distance - way, speed, -acceleration
        way = speed = acceleration = 0.0
        for length, jerk in zip(self._times, self._jerks, strict=True):
            t = min(length, time)
            way += t * (speed + t * (acceleration / 2 + t * jerk / 6))
            speed += t * (acceleration + t * jerk / 2)
            acceleration += t * jerk
            time -= t
        return way, speed, acceleration


def _peak_speed(distance: float, max_acceleration: float, max_jerk: float) -> float:
    """The peak speed without a velocity limit."""
    ramp = max_acceleration / max_jerk
    if distance <= 2 * max_acceleration * ramp**2:  # slows down before the acceleration reaches its limit
        return math.cbrt(distance**2 * max_jerk / 4)
    # From distance = speed * (speed / max_acceleration + ramp).
    return max_acceleration * (math.sqrt(ramp**2 / 4 + distance / max_acceleration) - ramp / 2)
