"""A mobile base of LeRobot's, which is driven by velocities, as joints: each axis has a way and follows setpoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ibrobot_core.api import Vector, seconds
from ibrobot_lerobot_devices.units import Mapped, UnitProblem, columns

_GAIN = 2.0
"""Velocity that makes up for a distance from the setpoint [1/s]."""
_NEAR = 0.01
"""A base that is nearer to a setpoint at rest stands [m, rad]."""


class Base:
    """The axes of a base as joints, B of them. The position of one is the way driven along, or turned about, it.

    Axes are those of the base itself, so that `x` is how far it has driven ahead, wherever that was. The way is the sum
    of the velocities that LeRobot measures, and begins at 0.

    Args:
        axes: the mapped axes, in order.
        actions: LeRobot's name of the velocity of each axis, in actions and observations.
        measured: names of the features of observations.
        max_velocity: limits [m/s, rad/s], shape (B,).
        period_s: the control period [s].

    Raises:
        UnitProblem: if LeRobot does not measure a velocity.
    """

    def __init__(
        self,
        axes: Sequence[Mapped],
        actions: Mapping[str, str],
        measured: Sequence[str],
        max_velocity: Vector,
        period_s: float,
    ) -> None:
        self.features = [actions[each.feature] for each in axes]
        for name in self.features:
            if name not in measured:
                raise UnitProblem(f"LeRobot does not measure {name}, so that nothing says where the base is")
        self._factor, _ = columns(axes)
        self._max_velocity = max_velocity
        self._period_s = period_s
        self.velocity: Vector = np.zeros(len(axes))
        """As measured [m/s, rad/s], shape (B,)."""
        self.way: Vector = np.zeros(len(axes))
        """[m, rad], shape (B,)."""
        self._stamp_ns: int | None = None
        self._setpoint: Vector | None = None

    def measure(self, values: Mapping[str, float], stamp_ns: int) -> None:
        """Take a reading of LeRobot's in, which was made at `stamp_ns`."""
        velocity = self._factor * np.array([values.get(name, np.nan) for name in self.features])
        since_s = 0.0 if self._stamp_ns is None else max(0.0, seconds(stamp_ns - self._stamp_ns))
        self.way = self.way + (self.velocity + velocity) / 2 * since_s
        self.velocity, self._stamp_ns = velocity, stamp_ns

    def forget(self) -> None:
        """Let the next setpoint be a new beginning, e.g. after the torque was off."""
        self._setpoint = None

    def drive(self, setpoint: Vector) -> dict[str, float]:
        """LeRobot's velocities that follow a setpoint of this tick [m, rad], shape (B,)."""
        before, self._setpoint = self._setpoint, setpoint.copy()
        ahead = np.zeros_like(setpoint) if before is None else (setpoint - before) / self._period_s
        # A step that the safety layer would not make is a new beginning, e.g. after a reset.
        ahead = np.where(np.abs(ahead) > 1.5 * self._max_velocity, 0.0, ahead)
        away = setpoint - self.way
        wanted = np.where((ahead == 0) & (np.abs(away) < _NEAR), 0.0, ahead + _GAIN * away)
        wanted = np.clip(wanted, -self._max_velocity, self._max_velocity)
        return dict(zip(self.features, (wanted / self._factor).tolist(), strict=True))
