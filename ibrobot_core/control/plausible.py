"""Plausibility of readings: a joint cannot be somewhere else at once."""

from __future__ import annotations

import numpy as np

from ibrobot_core.robot import Robot, Vector
from ibrobot_core.units import seconds

KNOCKED = 20.0
"""Speed that a joint may have when something strikes it [rad/s]: well above those of arms that fall or are pushed."""


class Plausibility:
    """Detects readings to which no joint can have moved, e.g. after damage to a reply that its checksum missed.

    Within a control period a joint moves at most at `KNOCKED` or at twice its `max_velocity`, whichever is more; in the
    time for which it was not measured, a period at least, it moves at most at its `max_velocity`.

    Args:
        robot: the joints.
        period_ns: the control period [ns].
    """

    def __init__(self, robot: Robot, period_ns: int) -> None:
        self._names = robot.joint_names
        self._velocity = robot.max_velocity
        self._knock: Vector = np.maximum(KNOCKED, 2 * self._velocity) * seconds(period_ns)

    def jump(self, before: Vector, now: Vector, since_ns: int) -> str:
        """What is implausible about positions `now` after `before` [rad], shape (J,); empty if nothing is.

        Args:
            before: the last positions that were believed.
            now: the measured positions; one that is not finite is missing, which is as implausible.
            since_ns: time since `before` was measured [ns].
        """
        if not (finite := np.isfinite(now)).all():
            joint = int(np.argmin(finite))
            return f"joint {self._names[joint]} is measured at {now[joint]}; check its encoder and cable"
        away = np.abs(now - before)
        beyond = away > self._knock + self._velocity * seconds(since_ns)
        if not beyond.any():
            return ""
        joint = int(np.where(beyond, away, -1.0).argmax())
        return (
            f"joint {self._names[joint]} is measured {away[joint]:.2f} rad away from where it was, which is not "
            "believed; check its encoder and cable"
        )
