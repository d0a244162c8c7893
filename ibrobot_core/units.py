"""All conversions between SI and the units of drivers and datasets."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

NS_PER_S = 1_000_000_000
"""Nanoseconds per second."""


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
"""Encoder positions per turn of a servo (12 bit)."""

NORM_MODES = ("radians", "degrees", "range_m100_100")
"""Units of joint positions in datasets and policies: SI or LeRobot's."""

LEROBOT_MODES = ("range_m100_100", "range_0_100", "degrees")
"""LeRobot's units of joint positions, named as in its `MotorNormMode`."""


def ticks_to_radians[T: (float, NDArray[Any])](ticks: T, *, zero: ArrayLike = 2048.0, inverted: ArrayLike = False) -> T:
    """Servo ticks -> radians: `(ticks - zero) 2 pi / 4096`, negated for an inverted joint.

    Args:
        ticks: positions reported by the servo; a number or an array of any shape.
        zero: the tick at which the joint is at 0 rad; a number, or one per joint.
        inverted: whether radians decrease as ticks increase (LeRobot's `drive_mode` 1); likewise.
    """
    converted: T = (ticks - np.asarray(zero)) * _sign(inverted) * (2 * math.pi / TICKS_PER_TURN)
    return converted


def radians_to_ticks[T: (float, NDArray[Any])](
    radians: T, *, zero: ArrayLike = 2048.0, inverted: ArrayLike = False
) -> T:
    """Radians -> servo ticks, not rounded; the inverse of `ticks_to_radians`."""
    ticks: T = radians * _sign(inverted) * (TICKS_PER_TURN / (2 * math.pi)) + np.asarray(zero)
    return ticks


def ticks_to_lerobot[T: (float, NDArray[Any])](
    ticks: T, mode: str, *, range_min: ArrayLike, range_max: ArrayLike, inverted: ArrayLike = False
) -> T:
    """Servo ticks -> LeRobot's units, as its `MotorsBus` (0.6) normalises them.

    - `range_m100_100`: `range_min` to `range_max` -> -100 to 100, clipped; negated if inverted.
    - `range_0_100` (the gripper): -> 0 to 100, clipped; subtracted from 100 if inverted.
    - `degrees`: from the middle of the range, `360 / 4095` degrees a tick, neither clipped nor inverted.

    Args:
        ticks: positions reported by the servo; a number or an array of any shape.
        mode: one of `LEROBOT_MODES`.
        range_min: the least position of the calibrated range [ticks]; a number, or one per joint.
        range_max: the greatest position; likewise.
        inverted: LeRobot's `drive_mode` 1; likewise.

    Raises:
        ValueError: for an unknown mode or an empty range.
    """
    low, high = _range(mode, range_min, range_max)
    converted: T
    if mode == "degrees":
        converted = (ticks - (low + high) / 2) * 360 / (TICKS_PER_TURN - 1)
        return converted
    fraction = (np.clip(ticks, low, high) - low) / (high - low)
    if mode == "range_m100_100":
        converted = (fraction * 200 - 100) * _sign(inverted)
    else:
        scaled: Any = np.where(inverted, 100 - fraction * 100, fraction * 100)
        converted = scaled[()]
    return converted


def lerobot_to_ticks[T: (float, NDArray[Any])](
    values: T, mode: str, *, range_min: ArrayLike, range_max: ArrayLike, inverted: ArrayLike = False
) -> T:
    """LeRobot's units -> servo ticks, not rounded (LeRobot truncates them); see `ticks_to_lerobot`.

    Raises:
        ValueError: for an unknown mode or an empty range.
    """
    low, high = _range(mode, range_min, range_max)
    ticks: T
    if mode == "degrees":
        ticks = values * (TICKS_PER_TURN - 1) / 360 + (low + high) / 2
        return ticks
    if mode == "range_m100_100":
        fraction = (np.clip(values * _sign(inverted), -100.0, 100.0) + 100) / 200
    else:
        fraction = np.clip(np.where(inverted, 100 - values, values), 0.0, 100.0) / 100
    ticks = (fraction * (high - low) + low)[()]
    return ticks


def radians_to_lerobot[T: (float, NDArray[Any])](
    radians: T,
    mode: str,
    *,
    range_min: ArrayLike,
    range_max: ArrayLike,
    zero: ArrayLike = 2048.0,
    inverted: ArrayLike = False,
) -> T:
    """Radians -> LeRobot's units, by way of unrounded ticks; see `ticks_to_radians`, `ticks_to_lerobot`.

    Raises:
        ValueError: for an unknown mode or an empty range.
    """
    ticks = radians_to_ticks(radians, zero=zero, inverted=inverted)
    return ticks_to_lerobot(ticks, mode, range_min=range_min, range_max=range_max, inverted=inverted)


def lerobot_to_radians[T: (float, NDArray[Any])](
    values: T,
    mode: str,
    *,
    range_min: ArrayLike,
    range_max: ArrayLike,
    zero: ArrayLike = 2048.0,
    inverted: ArrayLike = False,
) -> T:
    """LeRobot's units -> radians, by way of unrounded ticks; the inverse of `radians_to_lerobot`.

    Raises:
        ValueError: for an unknown mode or an empty range.
    """
    ticks = lerobot_to_ticks(values, mode, range_min=range_min, range_max=range_max, inverted=inverted)
    return ticks_to_radians(ticks, zero=zero, inverted=inverted)


def _sign(inverted: ArrayLike) -> Any:
    return np.where(inverted, -1.0, 1.0)[()]


def _range(mode: str, range_min: ArrayLike, range_max: ArrayLike) -> tuple[Any, Any]:
    if mode not in LEROBOT_MODES:
        raise ValueError(f"unknown unit {mode!r}; LeRobot has: {', '.join(LEROBOT_MODES)}")
    low, high = np.asarray(range_min), np.asarray(range_max)
    if not np.all(low < high):
        raise ValueError(f"range_min ({low}) must be below range_max ({high})")
    return low, high
