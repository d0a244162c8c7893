"""Following error: detects joints that stay away from their setpoints: blocked, without torque, or exchanged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.robot import LAG_S, Robot, Vector
from ibrobot_core.schema import Following
from ibrobot_core.units import ns

_EXCHANGED_RAD = 0.1
"""Distance from their own setpoints from which joints may be exchanged [rad]."""
_EXCHANGED_S = 0.3
"""How long joints follow each other's commands before they count as exchanged [s]; lagging joints do so for less."""


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
        self._soon = max(1, round(ns(_EXCHANGED_S) / period_ns))
        self._others = np.zeros((len(distance), len(distance)), dtype=np.int64)
        """For how many ticks each joint has been where another is commanded, shape (J, J)."""
        self._home: Vector = np.full(len(distance), np.nan)
        """Where the joints were when they were last at their setpoints [rad], shape (J,)."""

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
        if fault := self._exchanged(setpoint, away - LAG_S * np.abs(velocity), measured):
            return fault
        self._ticks = np.where(away > self._distance + LAG_S * np.abs(velocity), self._ticks + 1, 0)
        if not self.lost.any():
            return ""
        joint = int(np.where(self.lost, away, -1.0).argmax())
        return (
            f"joint {self._robot.joint_names[joint]} does not follow: it is {away[joint]:.2f} rad from its setpoint, "
            f"and has been away for {self._timeout:g} s; check what is in its way, its load, and that its motor has "
            "power and torque; a joint that is meant to squeeze needs `grips: true`"
        )

    def _exchanged(self, setpoint: Vector, away: Vector, measured: Vector) -> str:
        """What is wrong if joints move as others are commanded, one in place of the other; empty otherwise.

        Args:
            setpoint: the commands [rad], shape (J,).
            away: distance of each joint from its own, less its lag [rad], shape (J,).
            measured: measured positions [rad], shape (J,).
        """
        self._home = np.where((away < _EXCHANGED_RAD / 5) | np.isnan(self._home), measured, self._home)
        strays = away > _EXCHANGED_RAD
        if np.count_nonzero(strays) < 2:
            self._others[:] = 0
            return ""
        # Row: a joint that strays; column: one at whose setpoint it is instead.
        near = np.abs(measured[:, None] - setpoint) < away[:, None] / 4
        self._others = np.where(near & strays & strays[:, None], self._others + 1, 0)
        there = self._others >= self._soon
        moved = np.abs(measured - self._home) > _EXCHANGED_RAD
        pairs = np.argwhere(there & there.any(axis=1) & moved[:, None])
        if not len(pairs):
            return ""
        one, other = (self._robot.joint_names[index] for index in pairs[0])
        return (
            f"joint {one} moves as {other} is commanded, and {other} as another joint: their motors are exchanged; "
            "check their ids and cables, and the order of the hardware's joints"
        )
