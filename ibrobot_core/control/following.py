"""Following error: detects joints that stay away from their setpoints because they are blocked or lack torque."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.config.schema import Following
from ibrobot_core.robot import LAG_S, Robot, Vector
from ibrobot_core.units import ns


class FollowingError:
    """Monitors the distance between setpoint and measured position of each joint.

    A joint is away if the distance exceeds `distance` (or half of its `max_lead`, if that is less) plus the usual lag
    of a servo at the setpoint's speed. A joint that is away for `timeout` without interruption does not follow. Joints
    that grip may stay away indefinitely, because that is how they hold an object.

    Args:
        options: `distance` and `timeout`.
        robot: the joints; J is their number.
        period_ns: the control period [ns]; `check` is called at most once in each.
    """

    def __init__(self, options: Following, robot: Robot, period_ns: int) -> None:
        self._robot = robot
        self._timeout = options.timeout
        distance = np.minimum(options.distance, robot.max_lead / 2)
        self._distance: Vector = np.where(robot.grips, np.inf, distance)
        self._longest = max(1, round(ns(options.timeout) / period_ns))
        self._ticks = np.zeros(len(distance), dtype=np.int64)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which joints do not follow, shape (J,)."""
        return self._ticks >= self._longest

    def check(self, setpoint: Vector, velocity: Vector, measured: Vector) -> str:
        """Check the values of one tick, all of shape (J,).

        Args:
            setpoint: the command of the joints [rad].
            velocity: speed of the setpoint [rad/s].
            measured: measured positions [rad].

        Returns:
            Problem and remedy for the joint that is furthest away; empty if all joints follow.
        """
        away = np.abs(setpoint - measured)
        self._ticks = np.where(away > self._distance + LAG_S * np.abs(velocity), self._ticks + 1, 0)
        if not self.lost.any():
            return ""
        joint = int(np.where(self.lost, away, -1.0).argmax())
        return (
            f"joint {self._robot.joint_names[joint]} does not follow: it is {away[joint]:.2f} rad from its setpoint, "
            f"and has been away for {self._timeout:g} s; check what is in its way, its load, and that its motor has "
            "power and torque; a joint that is meant to squeeze needs `grips: true`"
        )
