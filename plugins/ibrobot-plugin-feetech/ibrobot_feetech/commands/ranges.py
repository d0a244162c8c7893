"""Calibration arithmetic: homing offsets, ranges that cross the end of the encoder, plausibility checks.

Measuring does not need to write to a servo. It reports its encoder's position minus its offset. Both are known, so the
position that it would report with any other offset can be computed.
"""

from __future__ import annotations

import attrs
from ibrobot_calibration import JointCalibration
from ibrobot_calibration.plausibility import LEAST_SPAN, misfits

from ibrobot_core.api import CalibrationError
from ibrobot_feetech.commands.joints import Joint
from ibrobot_feetech.ticks import MIDDLE_TICK, TICKS_PER_TURN


def homing_offset(joint: str, encoder: int) -> int:
    """The offset with which a servo whose encoder is at `encoder` [ticks] reports the middle.

    Raises:
        CalibrationError: if the offset does not fit into the servo's register.
    """
    offset = encoder - MIDDLE_TICK
    most = JointCalibration.MAX_HOMING_OFFSET
    if abs(offset) > most:
        raise CalibrationError(
            f"{joint}: in the middle pose its encoder is at {encoder}, which needs an offset of {offset}, but a servo "
            f"accepts -{most} to {most}: move the joint a little; if that does not help, "
            "turn the servo's horn by half a turn and mount it again"
        )
    return offset


@attrs.define
class Range:
    """The range over which a joint was moved, in ticks; may extend beyond 0 to 4095."""

    least: int
    now: int
    greatest: int

    @classmethod
    def at(cls, reported: int) -> Range:
        """The range of a joint that was not moved yet."""
        return cls(reported, reported, reported)

    def follow(self, reported: int) -> None:
        """Add a reported position, 0 to 4095; of the two ways from the last one, the shorter is assumed."""
        half = TICKS_PER_TURN // 2
        self.now += (reported - self.now + half) % TICKS_PER_TURN - half
        self.least, self.greatest = min(self.least, self.now), max(self.greatest, self.now)

    @property
    def span(self) -> int:
        """Size of the range [ticks]."""
        return self.greatest - self.least

    @property
    def crosses(self) -> bool:
        """Whether it crosses the encoder's end."""
        return self.least < 0 or self.greatest >= TICKS_PER_TURN


def impossible(joint: str, measured: Range) -> str | None:
    """The reason why a range is unusable; None if it is usable."""
    if measured.crosses:
        return (
            f"{joint}: its range {measured.least} to {measured.greatest} crosses the encoder's end (0/4095): "
            "the joint was not in the middle of its range in the middle pose; start again with it there"
        )
    if measured.span < LEAST_SPAN:
        return f"{joint}: it moved by only {measured.span} ticks ({_deg(measured.span):.0f} deg): move it to both ends"
    return None


def doubtful(joint: Joint, measured: Range, zero_at: str = "pose") -> str | None:
    """The reason why a range does not match the joint's limits; None if it does."""
    limits = joint.lower, joint.upper
    doubts = misfits(joint.name, measured.least, measured.greatest, limits, zero_at=zero_at, closed=joint.anchored)
    return next(doubts, None)


def _deg(ticks: float) -> float:
    return ticks * 360 / TICKS_PER_TURN
