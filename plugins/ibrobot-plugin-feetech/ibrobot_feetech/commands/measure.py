"""The dialogue that measures an arm: middle pose, ranges and signs. It writes nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
from ibrobot_calibration import JointCalibration
from ibrobot_terminal import Guide
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import CalibrationError
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.joints import Joint
from ibrobot_feetech.commands.ranges import Range, doubtful, homing_offset, impossible
from ibrobot_feetech.ticks import TICKS_PER_TURN

_COLUMNS = (">id", "joint", ">min", ">now", ">max", ">span", "")
_TURNED = 40
"""A joint that moved by this much was turned on purpose [ticks]."""


@attrs.frozen
class Answers:
    """Answers given by flags."""

    middle_now: bool = False
    range_seconds: float | None = None
    accept_ranges: bool = False
    check_signs: bool = False


class Measurement:
    """Measures one arm, whose torque is off.

    Args:
        bus: an open bus.
        guide: the operator.
        joints: the arm's joints.
        zero_at: position of 0 rad, one of `calibration.ZERO_AT`.
        full_turn: joints that can make a full turn, which is then their range.
        compared: joints whose range is compared with their limits.
        answers: answers given by flags.
    """

    def __init__(
        self, bus: FeetechBus, guide: Guide, joints: Sequence[Joint], *, full_turn: Sequence[str],
        compared: Sequence[str], zero_at: str, answers: Answers,
    ) -> None:  # fmt: skip
        self._bus = bus
        self._guide = guide
        self._joints = joints
        self._ids = [joint.servo for joint in joints]
        self._measured = [joint for joint in joints if joint.name not in full_turn]
        self._compared = compared
        self._zero_at = zero_at
        self._answers = answers
        self._kept = {servo: bus.read(servo, "homing_offset") for servo in self._ids}

    def run(self) -> dict[str, JointCalibration]:
        """Run the dialogue.

        Raises:
            CalibrationError: if the measured values are impossible.
            FeetechError: if a servo stops answering.
        """
        offsets = self._middle()
        ranges = self._ranges(offsets)
        inverted = {joint.name: self._is_inverted(joint) for joint in self._joints} if self._answers.check_signs else {}
        return as_calibration(self._joints, offsets, ranges, inverted, self._zero_at)

    def _encoders(self) -> dict[int, int]:
        """Servo id -> its encoder's position [ticks], 0 to 4095."""
        positions = self._bus.sync_read("present_position", self._ids)
        return {servo: (position + self._kept[servo]) % TICKS_PER_TURN for servo, position in positions.items()}

    def _middle(self) -> dict[int, int]:
        """Servo id -> homing offset."""
        request = "Move every joint to the middle of its range."
        while True:
            if not self._answers.middle_now:
                self._guide.wait(request, flag="--middle-now")
            encoders = self._encoders()
            try:
                return {joint.servo: homing_offset(joint.name, encoders[joint.servo]) for joint in self._joints}
            except CalibrationError as error:
                if self._answers.middle_now:
                    raise
                self._guide.say(f"error: {error}", warning=True)

    def _ranges(self, offsets: Mapping[int, int]) -> dict[str, Range]:
        reported = self._reported(offsets)
        ranges = {joint.name: Range.at(reported[joint.servo]) for joint in self._measured}
        while True:
            self._follow(offsets, ranges)
            wrong = [text for joint in self._measured if (text := impossible(joint.name, ranges[joint.name]))]
            crossed = any(measured.crosses for measured in ranges.values())
            if not wrong and self._accepted(ranges):
                return ranges
            refused = "\n".join(wrong) or "the ranges were not accepted; --accept-ranges accepts them"
            if crossed or self._answers.range_seconds is not None:
                raise CalibrationError(refused)
            self._guide.say(refused, warning=True)
            if not self._guide.confirm("Measure on?", flag="--range-seconds", default=True):
                raise Declined

    def _accepted(self, ranges: Mapping[str, Range]) -> bool:
        compared = [joint for joint in self._measured if joint.name in self._compared]
        doubts = [text for joint in compared if (text := doubtful(joint, ranges[joint.name], self._zero_at))]
        for text in doubts:
            self._guide.say(f"warning: {text}", warning=True)
        if not doubts or self._answers.accept_ranges:
            return True
        return self._answers.range_seconds is None and self._guide.confirm(
            "Use these ranges anyway?", flag="--accept-ranges"
        )

    def _reported(self, offsets: Mapping[int, int]) -> dict[int, int]:
        """Servo id -> position that it will report with its new offset [ticks], 0 to 4095."""
        return {servo: (encoder - offsets[servo]) % TICKS_PER_TURN for servo, encoder in self._encoders().items()}

    def _follow(self, offsets: Mapping[int, int], ranges: Mapping[str, Range]) -> None:
        """Record the joints' positions until the operator, or the time, ends it."""

        def rows() -> list[tuple[str, ...]]:
            reported = self._reported(offsets)
            for joint in self._measured:
                ranges[joint.name].follow(reported[joint.servo])
            return _rows(self._measured, ranges)

        self._guide.wait(
            "Move each joint in the table to both ends.",
            flag="--range-seconds",
            columns=_COLUMNS,
            rows=rows,
            seconds=self._answers.range_seconds,
        )

    def _is_inverted(self, joint: Joint) -> bool:
        """Whether radians decrease as ticks increase."""
        moved = turned_by_hand(self._bus, self._guide, joint.name, joint.servo)
        if moved < 0:
            self._guide.say(
                f"warning: {joint.name}: ticks decrease as its angle increases: it is stored as inverted", warning=True
            )
        return moved < 0


def turned_by_hand(bus: FeetechBus, guide: Guide, joint: str, servo: int) -> int:
    """Ask to turn a joint in its positive direction until it has moved; returns by how much [ticks]."""
    while True:
        before = bus.read(servo, "present_position")
        guide.wait(f"Turn {joint} a little in its positive direction.", flag="no --check-signs")
        half = TICKS_PER_TURN // 2
        moved = (bus.read(servo, "present_position") - before + half) % TICKS_PER_TURN - half
        if abs(moved) >= _TURNED:
            return moved
        guide.say(
            f"error: {joint} moved by {moved} ticks, and must move by {_TURNED} at least; try again", warning=True
        )


def as_calibration(
    joints: Sequence[Joint], offsets: Mapping[int, int], ranges: Mapping[str, Range], inverted: Mapping[str, bool],
    zero_at: str,
) -> dict[str, JointCalibration]:  # fmt: skip
    """What was measured, as a calibration; joints without a range can make a full turn."""
    whole = Range(0, 0, TICKS_PER_TURN - 1)
    by_joint = {}
    for joint in joints:
        measured = ranges.get(joint.name, whole)
        by_joint[joint.name] = JointCalibration(
            id=joint.servo,
            drive_mode=int(inverted.get(joint.name, False)),
            homing_offset=offsets[joint.servo],
            range_min=measured.least,
            range_max=measured.greatest,
            zero_at=zero_at,
        )
    return by_joint


def _rows(joints: Sequence[Joint], ranges: Mapping[str, Range]) -> list[tuple[str, ...]]:
    made = []
    for joint in joints:
        span = ranges[joint.name]
        numbers = (span.least, span.now, span.greatest, span.span)
        remark = "crosses 0/4095" if span.crosses else ""
        made.append((str(joint.servo), joint.name, *map(str, numbers), remark))
    return made
