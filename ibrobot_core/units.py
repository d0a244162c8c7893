"""Conversions between SI and the units of drivers and datasets; nowhere else are there any."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

NS_PER_S = 1_000_000_000


def ns(seconds: float) -> int:
    """Seconds -> integer nanoseconds, rounded to the nearest."""
    return round(seconds * NS_PER_S)


def seconds(nanoseconds: int) -> float:
    """Integer nanoseconds -> seconds."""
    return nanoseconds / NS_PER_S


def degrees(radians: float) -> float:
    """Radians -> degrees."""
    return radians * 180.0 / math.pi


def radians(degrees: float) -> float:
    """Degrees -> radians."""
    return degrees * math.pi / 180.0


TICKS_PER_TURN = 4096
"""Positions of a servo's encoder in one turn (12 bit)."""

LEROBOT_MODES = ("range_m100_100", "range_0_100", "degrees")
"""Units of joint positions in LeRobot, by the names of its `MotorNormMode`."""


def ticks_to_radians[T: (float, NDArray[np.float64])](
    ticks: T, *, zero: float | NDArray[np.float64] = 2048.0, inverted: bool | NDArray[np.bool_] = False
) -> T:
    """Servo ticks -> radians: `(ticks - zero) 2 pi / 4096`, negated for an inverted joint.

    Args:
        ticks: positions as the servo reports them; a number, or an array of any shape.
        zero: the tick at which the joint is at 0 rad.
        inverted: whether radians fall while ticks grow (LeRobot's `drive_mode` 1).
    """
    angle = (ticks - zero) * (2 * math.pi / TICKS_PER_TURN)
    return angle * _sign(inverted)  # type: ignore[return-value]


def radians_to_ticks[T: (float, NDArray[np.float64])](
    radians: T, *, zero: float | NDArray[np.float64] = 2048.0, inverted: bool | NDArray[np.bool_] = False
) -> T:
    """Radians -> servo ticks, not rounded; the inverse of `ticks_to_radians`."""
    return radians * _sign(inverted) * (TICKS_PER_TURN / (2 * math.pi)) + zero  # type: ignore[return-value]


def ticks_to_lerobot(ticks: float, mode: str, *, range_min: int, range_max: int, inverted: bool = False) -> float:
    """Servo ticks -> LeRobot's units, as its `MotorsBus` (0.6) normalises them.

    - `range_m100_100`: `range_min`..`range_max` -> -100..100, clipped; negated where inverted.
    - `range_0_100` (the gripper): -> 0..100, clipped; 100 less it where inverted.
    - `degrees`: from the middle of the range, `360 / 4095` degrees a tick, neither clipped nor inverted.

    Args:
        ticks: a position as the servo reports it.
        mode: one of `LEROBOT_MODES`.
        range_min: the least position of the calibrated range [ticks].
        range_max: the greatest.
        inverted: LeRobot's `drive_mode` 1.

    Raises:
        ValueError: for an unknown mode or an empty range.
    """
    _check(mode, range_min, range_max)
    if mode == "degrees":
        return (ticks - (range_min + range_max) / 2) * 360 / (TICKS_PER_TURN - 1)
    fraction = (min(range_max, max(range_min, ticks)) - range_min) / (range_max - range_min)
    if mode == "range_m100_100":
        value = fraction * 200 - 100
        return -value if inverted else value
    return 100 - fraction * 100 if inverted else fraction * 100


def lerobot_to_ticks(value: float, mode: str, *, range_min: int, range_max: int, inverted: bool = False) -> float:
    """LeRobot's units -> servo ticks, not rounded (LeRobot cuts the fraction off); see `ticks_to_lerobot`.

    Raises:
        ValueError: for an unknown mode or an empty range.
    """
    _check(mode, range_min, range_max)
    if mode == "degrees":
        return value * (TICKS_PER_TURN - 1) / 360 + (range_min + range_max) / 2
    if mode == "range_m100_100":
        fraction = (min(100.0, max(-100.0, -value if inverted else value)) + 100) / 200
    else:
        fraction = min(100.0, max(0.0, 100 - value if inverted else value)) / 100
    return fraction * (range_max - range_min) + range_min


def _sign(inverted: bool | NDArray[np.bool_]) -> float | NDArray[np.float64]:
    return np.where(inverted, -1.0, 1.0) if isinstance(inverted, np.ndarray) else 1.0 - 2.0 * inverted


def _check(mode: str, range_min: int, range_max: int) -> None:
    if mode not in LEROBOT_MODES:
        raise ValueError(f"unknown unit {mode!r}; LeRobot has: {', '.join(LEROBOT_MODES)}")
    if not range_min < range_max:
        raise ValueError(f"range_min ({range_min}) must be below range_max ({range_max})")
