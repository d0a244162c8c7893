"""Conversions between SI and the units of drivers and datasets; nowhere else are there any."""

from __future__ import annotations

import math

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
