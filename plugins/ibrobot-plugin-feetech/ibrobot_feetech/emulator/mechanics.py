"""The mechanics of an emulated joint: stops, friction, its weight, and what is in its way."""

from __future__ import annotations

import math

import attrs

from ibrobot_feetech.ticks import TICKS_PER_RADIAN

FREE_SPEED = 3073.0
"""Speed of the motor at full duty without load [ticks/s]: 0.222 s for 60 degrees at 12 V."""
STALL_CURRENT_A = 2.7
"""Current of a motor that stands still at full duty, at 12 V."""
_STOP = 0.1
"""Stiffness of a stop [of stall torque per tick]."""
_LAG_S = 0.02
"""Time in which the speed follows the torque."""
_STEP_S = 1e-3
_STILL = 2.0
"""Slower than this counts as standing still [ticks/s]."""
_BEYOND = 0.02
"""Distance from a joint's limit to its stop [of its range]."""
_WEIGHTS = {"shoulder_lift": 0.19, "elbow_flex": 0.16, "wrist_flex": 0.04}
"""Torques of an SO-101's weight in the middle pose, by its MJCF [of 2.94 Nm, the stall torque at 12 V]."""


@attrs.define(kw_only=True)
class Mechanics:
    """Forces on a joint.

    Positions are those of the encoder [ticks], beyond 0 to 4095 too; torques are shares of the stall torque.
    """

    low: float = -math.inf
    """The stop at the lower end."""
    high: float = math.inf
    friction: float = 0.04
    """Dry friction."""
    gravity: float = 0.0
    """Torque of the weight where the lever is horizontal; positive ones pull to greater positions."""
    level: float = 2048.0
    """Where the lever is horizontal."""
    cable: float | None = None
    """Where a cable is taut, which then pulls back; above the middle of the stops, or `level` of a joint that has none,
    it is in the way upwards."""
    cable_stiffness: float = 0.002
    """[of stall torque per tick]"""
    sticky: tuple[float, float, float] | None = None
    """From where to where the friction is another one, and which."""
    hand: float | None = None
    """Where a hand holds the joint; None: nowhere."""
    supported: bool = True
    """Whether a person holds the arm while its torque is off; otherwise it falls."""

    def advance(self, encoder: float, velocity: float, duty: float, elapsed_s: float) -> tuple[float, float]:
        """Position [ticks] and speed [ticks/s] after a time with the motor's duty cycle, -1 to 1."""
        remaining = elapsed_s
        while remaining > 1e-9:
            step = min(_STEP_S, remaining)
            remaining -= step
            drive = duty + self._load(encoder)
            friction = self._friction(encoder)
            if abs(velocity) < _STILL and abs(drive) <= friction:
                velocity = 0.0
                continue
            way = math.copysign(1.0, velocity if abs(velocity) >= _STILL else drive)
            wanted = FREE_SPEED * (drive - friction * way)
            changed = velocity + (wanted - velocity) * min(1.0, step / _LAG_S)
            velocity = 0.0 if changed * way < 0 else changed
            encoder += velocity * step
        return encoder, velocity

    def current_a(self, velocity: float, duty: float) -> float:
        """The motor's current [A], signed."""
        return STALL_CURRENT_A * (duty - velocity / FREE_SPEED)

    def _load(self, encoder: float) -> float:
        """Torque of all but motor and friction."""
        load = self.gravity * math.cos((encoder - self.level) / TICKS_PER_RADIAN)
        load += _STOP * (max(0.0, self.low - encoder) - max(0.0, encoder - self.high))
        if self.cable is not None:
            middle = (self.low + self.high) / 2
            upwards = self.cable > (middle if math.isfinite(middle) else self.level)
            taut = encoder - self.cable if upwards else self.cable - encoder
            load -= math.copysign(self.cable_stiffness * max(0.0, taut), 1.0 if upwards else -1.0)
        if self.hand is not None:
            load += _STOP * (self.hand - encoder)
        return load

    def _friction(self, encoder: float) -> float:
        if self.sticky is not None and self.sticky[0] <= encoder <= self.sticky[1]:
            return self.sticky[2]
        return self.friction


def mechanics_of(joint: str, lower: float, upper: float, middle: float) -> Mechanics:
    """About the mechanics of a joint of an SO-101.

    Args:
        joint: its name, with a prefix or without.
        lower: its limit [rad].
        upper: likewise.
        middle: encoder position in its middle pose, which is 0 rad [ticks].
    """
    room = _BEYOND * (upper - lower)
    low, high = (middle + angle * TICKS_PER_RADIAN for angle in (lower - room, upper + room))
    weight = next((each for name, each in _WEIGHTS.items() if joint.endswith(name)), 0.0)
    if joint.endswith("wrist_roll"):
        low, high = -math.inf, math.inf
    return Mechanics(low=low, high=high, gravity=weight, level=middle)
