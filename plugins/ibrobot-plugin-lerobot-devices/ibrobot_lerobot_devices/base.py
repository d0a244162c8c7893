"""A mobile base of LeRobot's, which is driven by velocities, as joints: each axis has a way and follows setpoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ibrobot_core.api import Vector, seconds
from ibrobot_lerobot_devices.units import Mapped, UnitProblem, columns

_GAIN = 4.0
"""Velocity that makes up for a distance from the setpoint, while that moves [1/s]."""
_SLOWEST = 2.0
"""Ratio of the velocity sent to the one measured up to which braking makes up for slow wheels."""
_NEAR = 0.004
"""A base that stands starts for a setpoint that has left it by so much [m, rad]."""
_BELIEVED = 5.0
"""A measured velocity above so many times the limit is no measurement."""


class Base:
    """The axes of a base as joints, B of them. The position of one is the way driven along, or turned about, it.

    Axes are those of the base itself, so that `x` is how far it has driven ahead, wherever that was. The way is the sum
    of the velocities that LeRobot measures, and begins at 0.

    A base is controlled by velocity: it drives as fast as its setpoint moves, and faster or slower if it is behind or
    ahead. It never drives against the motion of its setpoint. While that rests it brakes and stands, wherever it is,
    and it starts when its setpoint leaves it.

    Args:
        axes: the mapped axes, in order.
        actions: LeRobot's name of the velocity of each axis, in actions and observations.
        measured: names of the features of observations.
        max_velocity: limits [m/s, rad/s], shape (B,).
        max_acceleration: limits [m/s^2, rad/s^2], shape (B,).
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
        max_acceleration: Vector,
        period_s: float,
    ) -> None:
        self.features = [actions[each.feature] for each in axes]
        for name in self.features:
            if name not in measured:
                raise UnitProblem(f"LeRobot does not measure {name}, so that nothing says where the base is")
        self._factor, _ = columns(axes)
        self._max_velocity = max_velocity
        self._change = max_acceleration * period_s
        self._period_s = period_s
        self.velocity: Vector = np.zeros(len(axes))
        """Measured velocity [m/s, rad/s], shape (B,)."""
        self.way: Vector = np.zeros(len(axes))
        """[m, rad], shape (B,)."""
        self._stamp_ns: int | None = None
        self._setpoint: Vector | None = None
        self._ahead: Vector = np.zeros(len(axes))
        """Velocity of the setpoint [m/s, rad/s], shape (B,)."""
        self._sent: Vector = np.zeros(len(axes))
        """The velocity last sent [m/s, rad/s], shape (B,)."""

    def wrong(self, values: Mapping[str, float]) -> str:
        """Why a reading of LeRobot's is no measurement of the velocities; empty if it is one."""
        for name, factor, fastest in zip(self.features, self._factor, self._max_velocity, strict=True):
            value = values.get(name)
            if value is None:
                return f"LeRobot's reading has no {name}"
            if not abs(factor * value) <= _BELIEVED * fastest:  # also if it is NaN
                return f"LeRobot measures {name} as {value:g}, which the base cannot reach"
        return ""

    def measure(self, values: Mapping[str, float], stamp_ns: int) -> None:
        """Take a reading of LeRobot's in, which was made at `stamp_ns` and is not `wrong`."""
        velocity = self._factor * np.array([values[name] for name in self.features])
        since_s = 0.0 if self._stamp_ns is None else max(0.0, seconds(stamp_ns - self._stamp_ns))
        self.way = self.way + (self.velocity + velocity) / 2 * since_s
        self.velocity, self._stamp_ns = velocity, stamp_ns

    def forget(self) -> None:
        """Let the next setpoint be a new beginning, e.g. after the torque was off."""
        self._setpoint = None

    @property
    def drives(self) -> bool:
        """Whether it was sent or measured to move."""
        return bool(self._sent.any() or self.velocity.any())

    def drive(self, setpoint: Vector) -> dict[str, float]:
        """LeRobot's velocities that follow a setpoint of this tick [m, rad], shape (B,)."""
        before, self._setpoint = self._setpoint, setpoint.copy()
        ahead = np.zeros_like(setpoint) if before is None else (setpoint - before) / self._period_s
        # A step that the safety layer would not make is a new beginning, e.g. after a reset.
        ahead = np.where(np.abs(ahead) > 1.5 * self._max_velocity, 0.0, ahead)
        speed, away = np.abs(ahead), setpoint - self.way
        wanted = ahead + np.clip(_GAIN * away, -speed, speed)
        # A setpoint that comes to where the base stands, e.g. as a mode begins, is no reason to drive.
        leaves = (ahead * away > 0) & (np.abs(away) > _NEAR)
        wanted = np.where((self._sent == 0) & ~leaves, 0.0, wanted)
        # While the setpoint brakes, so does the base, however far it is behind.
        fastest = np.where(speed < np.abs(self._ahead), np.abs(self._sent), self._max_velocity)
        wanted = np.clip(wanted, -fastest, fastest)
        # Wheels that are slower than commanded slow down less, too: their own braking stays within the limits.
        slower = self._change * np.clip(np.abs(self._sent) / np.maximum(np.abs(self.velocity), 1e-9), 1.0, _SLOWEST)
        forward = self._sent > 0
        down, up = np.where(forward, slower, self._change), np.where(forward, self._change, slower)
        sent = np.clip(wanted, self._sent - down, self._sent + up)
        self._ahead, self._sent = ahead, np.where(sent * self._sent < 0, 0.0, sent)
        return dict(zip(self.features, (self._sent / self._factor).tolist(), strict=True))

    def stand(self) -> dict[str, float]:
        """LeRobot's velocities of a base that stands at once, e.g. since nothing measures it."""
        self.forget()
        self._ahead, self._sent = np.zeros_like(self._sent), np.zeros_like(self._sent)
        return dict.fromkeys(self.features, 0.0)
