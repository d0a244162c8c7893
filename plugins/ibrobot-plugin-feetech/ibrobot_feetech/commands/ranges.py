"""Arithmetic of calibrating: the homing offset, a range that is followed over the encoder's end, what is plausible.

Nothing needs to be written to a servo to measure: it reports its encoder's position less the offset that it has, so
both are known, and with them what it would report with any other offset.
"""

from __future__ import annotations

import math

import attrs

from ibrobot_core.api import MAX_HOMING_OFFSET, MIDDLE_TICK, TICKS_PER_TURN, ZERO_AT_POSE, CalibrationError, degrees
from ibrobot_feetech.commands.joints import Joint

_LEAST_SPAN = 150
"""A joint that moved by less was not moved [ticks]: 13 degrees."""
_TOLERANCE = 0.25
"""What part of its limits' span a measured span may differ by."""
_OFF_CENTRE = 230
"""How far the middle of a range may be from where the limits say [ticks]: 20 degrees."""


def homing_offset(joint: str, encoder: int) -> int:
    """The offset with which a servo whose encoder is at `encoder` [ticks] reports the middle.

    Raises:
        CalibrationError: when the servo cannot keep it.
    """
    offset = encoder - MIDDLE_TICK
    if abs(offset) > MAX_HOMING_OFFSET:
        raise CalibrationError(
            f"{joint}: in the middle pose its encoder is at {encoder}, which needs an offset of {offset}, and a servo "
            f"keeps -{MAX_HOMING_OFFSET} to {MAX_HOMING_OFFSET}: move the joint a little; if that does not help, "
            "mount the servo's horn half a turn on"
        )
    return offset


@attrs.define
class Range:
    """How far a joint was moved, in ticks from the middle's 0 to 4095 and beyond."""

    least: int
    now: int
    greatest: int

    @classmethod
    def at(cls, reported: int) -> Range:
        """A joint that was not moved yet."""
        return cls(reported, reported, reported)

    def follow(self, reported: int) -> None:
        """Take in a reported position, 0 to 4095: the shorter way from the last one, over the encoder's end or not."""
        half = TICKS_PER_TURN // 2
        self.now += (reported - self.now + half) % TICKS_PER_TURN - half
        self.least, self.greatest = min(self.least, self.now), max(self.greatest, self.now)

    @property
    def span(self) -> int:
        """How far it moved [ticks]."""
        return self.greatest - self.least

    @property
    def crosses(self) -> bool:
        """Whether it went over the encoder's end."""
        return self.least < 0 or self.greatest >= TICKS_PER_TURN


def impossible(joint: str, measured: Range) -> str | None:
    """Why a range cannot be used at all; None where it can."""
    if measured.crosses:
        return (
            f"{joint}: its range {measured.least} to {measured.greatest} crosses the encoder's end (0/4095): "
            "the joint was not in the middle of its range in the middle pose; begin again with it there"
        )
    if measured.span < _LEAST_SPAN:
        return f"{joint}: it moved by {measured.span} ticks ({_deg(measured.span):.0f} deg) only: did you move it?"
    return None


def doubtful(joint: Joint, measured: Range, zero_at: str = ZERO_AT_POSE) -> str | None:
    """Why a range does not look like the joint's limits; None where it does."""
    ticks = TICKS_PER_TURN / (2 * math.pi)
    expected = (joint.upper - joint.lower) * ticks
    if abs(measured.span - expected) > _TOLERANCE * expected:
        return (
            f"{joint.name}: it moved by {_deg(measured.span):.0f} deg, its limits are {_deg(expected):.0f} deg apart; "
            "was it moved to both ends, and is it the right joint?"
        )
    middle = abs((joint.lower + joint.upper) / 2) * ticks
    if zero_at != ZERO_AT_POSE:
        if joint.anchored or middle <= _OFF_CENTRE:
            return None
        return (
            f"{joint.name}: the middle of its limits is {_deg(middle):.0f} deg off 0, so 0 deg is not in the middle of "
            "its range: take --zero-at pose"
        )
    # The sign of the ticks is not known here: limits about 0 have their middle near 0 either way.
    off = abs((measured.least + measured.greatest) / 2 - MIDDLE_TICK) - middle
    if not joint.anchored and off > _OFF_CENTRE:
        return f"{joint.name}: the middle of its range is {_deg(off):.0f} deg off the middle pose, which is its 0 deg"
    return None


def _deg(ticks: float) -> float:
    return degrees(ticks * 2 * math.pi / TICKS_PER_TURN)
