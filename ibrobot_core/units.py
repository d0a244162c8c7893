"""Units of time, and the units of joint positions in datasets."""

from __future__ import annotations

NS_PER_S = 1_000_000_000
"""Nanoseconds per second."""


def ns(seconds: float) -> int:
    """Seconds -> integer nanoseconds, rounded to the nearest."""
    return round(seconds * NS_PER_S)


def seconds(nanoseconds: int) -> float:
    """Integer nanoseconds -> seconds."""
    return nanoseconds / NS_PER_S


NORM_MODES = ("radians", "degrees", "range_m100_100")
"""Units of joint positions in datasets and policies: SI or LeRobot's."""
