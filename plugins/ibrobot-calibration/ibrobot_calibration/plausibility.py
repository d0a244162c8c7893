"""What is odd about a calibration: numbers that no servo has, and ranges that are not those of the robot's joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from ibrobot_calibration.calibration import JointCalibration

TOLERANCE = 0.25
"""Largest relative difference between the span of a range and that of the joint's limits."""
OFF_CENTRE_DEG = 20.0
"""Largest distance between the middle of a range and the middle of the limits, with 0 rad in a pose set by hand."""
NEAR = 8
"""A range that ends so near the encoder's end passes it [ticks]."""
LEAST_SPAN = 150
"""A joint that moved by less was not moved [ticks]: 13 degrees."""
_LAST = JointCalibration.TICKS_PER_TURN - 1


def oddities(joint: str, numbers: Mapping[str, Any], limits: tuple[float, float] | None = None) -> Iterator[str]:
    """What is odd about the calibration of a joint; each with its number, the threshold and what to do.

    A joint whose range is a whole turn has no ends that could be wrong.

    Args:
        joint: its name.
        numbers: fields of `JointCalibration`.
        limits: lower and upper limit [rad] with which its range is compared; None: with none.
    """
    low, high, offset = (int(numbers[name]) for name in ("range_min", "range_max", "homing_offset"))
    most = JointCalibration.MAX_HOMING_OFFSET
    if abs(offset) > most:
        yield (
            f"{joint}: its offset is {offset} ticks, and a servo stores -{most} to {most}: turn its horn by half a "
            "turn, mount it again, and calibrate again"
        )
    if (low, high) == (0, _LAST):
        return
    if low <= NEAR or high >= _LAST - NEAR:
        yield (
            f"{joint}: its range of {low} to {high} ticks ends within {NEAR} ticks of the encoder's end "
            f"(0/{_LAST}), so it passes the end there: calibrate again, beginning in the middle of its range"
        )
        return
    if high - low < LEAST_SPAN:
        yield (
            f"{joint}: its range is {high - low} ticks ({_deg(high - low):.0f} deg), less than {LEAST_SPAN}: calibrate "
            "again, and move it to both ends"
        )
        return
    if limits is not None:
        zero_at, closed = str(numbers.get("zero_at", "pose")), numbers.get("closed_at") is not None
        yield from misfits(joint, low, high, limits, zero_at=zero_at, closed=closed)


def misfits(
    joint: str, low: float, high: float, limits: tuple[float, float], *, zero_at: str = "pose", closed: bool = False
) -> Iterator[str]:
    """Why a range [ticks] is not that of a joint with these limits [rad].

    Args:
        joint: its name.
        low: least reported position [ticks].
        high: greatest reported position [ticks].
        limits: lower and upper limit [rad].
        zero_at: position of 0 rad, one of `calibration.ZERO_AT`.
        closed: whether its angle is measured from its closed end.
    """
    lower, upper = limits
    ticks = JointCalibration.TICKS_PER_TURN / (2 * math.pi)
    span, expected = high - low, (upper - lower) * ticks
    if abs(span - expected) > TOLERANCE * expected:
        yield (
            f"{joint}: it moved by {_deg(span):.0f} deg, its limits are {_deg(expected):.0f} deg apart, and a "
            f"difference of {100 * TOLERANCE:.0f} % is allowed; check that it was moved to both ends, and that it is "
            "the right joint"
        )
        return
    if closed:
        return
    middle = abs((lower + upper) / 2) * ticks
    if zero_at != "pose":
        if _deg(middle) > OFF_CENTRE_DEG:
            yield (
                f"{joint}: the middle of its limits is {_deg(middle):.0f} deg off 0, more than "
                f"{OFF_CENTRE_DEG:.0f}, so 0 deg is not the middle of its range: use --zero-at pose"
            )
        return
    # The sign of the ticks is unknown here, but limits around 0 have their middle near 0 either way.
    off = _deg(abs((low + high) / 2 - JointCalibration.TICKS_PER_TURN / 2) - middle)
    if off > OFF_CENTRE_DEG:
        yield (
            f"{joint}: the middle of its range is {off:.0f} deg from the middle pose, which is its 0 deg, more than "
            f"{OFF_CENTRE_DEG:.0f}: calibrate again, beginning in the middle pose"
        )


def _deg(ticks: float) -> float:
    return ticks * 360 / JointCalibration.TICKS_PER_TURN
