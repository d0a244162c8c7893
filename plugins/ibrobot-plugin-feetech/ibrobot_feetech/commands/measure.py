"""The dialogue that measures an arm: middle pose, ranges and signs. It writes nothing."""

from __future__ import annotations

import queue
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack

import attrs
from rich.live import Live
from rich.table import Table

from ibrobot_core.api import TICKS_PER_TURN, CalibrationError, Declined, JointCalibration, KeyReader, Screen, echo
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import Unanswered, agree, interactive, table, wait_for_enter
from ibrobot_feetech.commands.joints import Joint
from ibrobot_feetech.commands.ranges import Range, doubtful, homing_offset, impossible

_PERIOD_S = 0.03
_TURNED = 40
"""A joint that moved by this much was turned on purpose [ticks]."""


@attrs.frozen
class Answers:
    """Answers given by flags."""

    middle_now: bool
    range_seconds: float | None
    accept_ranges: bool
    check_signs: bool


class Measurement:
    """Measures one arm, whose torque is off.

    Args:
        bus: an open bus.
        joints: the arm's joints.
        zero_at: position of 0 rad, one of `calibration.ZERO_AT`.
        full_turn: joints that can make a full turn, which is then their range.
        compared: joints whose range is compared with their limits.
        answers: answers given by flags.
    """

    def __init__(
        self, bus: FeetechBus, joints: Sequence[Joint], *, full_turn: Sequence[str], compared: Sequence[str],
        zero_at: str, answers: Answers,
    ) -> None:  # fmt: skip
        self._bus = bus
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
        whole = Range(0, 0, TICKS_PER_TURN - 1)
        inverted = {joint.name: self._is_inverted(joint) for joint in self._joints} if self._answers.check_signs else {}
        found = {}
        for joint in self._joints:
            measured = ranges.get(joint.name, whole)
            found[joint.name] = JointCalibration(
                id=joint.servo, drive_mode=int(inverted.get(joint.name, False)), homing_offset=offsets[joint.servo],
                range_min=measured.least, range_max=measured.greatest, zero_at=self._zero_at,
            )  # fmt: skip
        return found

    def _encoders(self) -> dict[int, int]:
        """Servo id -> its encoder's position [ticks], 0 to 4095."""
        positions = self._bus.sync_read("present_position", self._ids)
        return {servo: (position + self._kept[servo]) % TICKS_PER_TURN for servo, position in positions.items()}

    def _middle(self) -> dict[int, int]:
        """Servo id -> homing offset."""
        request = "Move every joint to the middle of its range."
        while True:
            if not self._answers.middle_now:
                wait_for_enter(request, flag="--middle-now")
            encoders = self._encoders()
            try:
                return {joint.servo: homing_offset(joint.name, encoders[joint.servo]) for joint in self._joints}
            except CalibrationError as error:
                if self._answers.middle_now:
                    raise
                echo(f"error: {error}", err=True)

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
            echo(refused, err=True)
            if not agree("Measure on?", flag="--range-seconds", default=True):
                raise Declined

    def _accepted(self, ranges: Mapping[str, Range]) -> bool:
        compared = [joint for joint in self._measured if joint.name in self._compared]
        doubts = [text for joint in compared if (text := doubtful(joint, ranges[joint.name], self._zero_at))]
        for text in doubts:
            echo(f"warning: {text}", err=True)
        if not doubts or self._answers.accept_ranges:
            return True
        return self._answers.range_seconds is None and agree("Use these ranges anyway?", flag="--accept-ranges")

    def _reported(self, offsets: Mapping[int, int]) -> dict[int, int]:
        """Servo id -> position that it will report with its new offset [ticks], 0 to 4095."""
        return {servo: (encoder - offsets[servo]) % TICKS_PER_TURN for servo, encoder in self._encoders().items()}

    def _follow(self, offsets: Mapping[int, int], ranges: Mapping[str, Range]) -> None:
        """Record the joints' positions until Enter or the end of the time."""
        seconds = self._answers.range_seconds
        if seconds is None and not interactive():
            raise Unanswered("There is no terminal to press Enter in; run the command in one, or give --range-seconds")
        end = "Enter ends it" if seconds is None else f"for {seconds:g} s"
        echo(f"Move each joint in the table to both ends ({end}).")
        until = time.monotonic() + (seconds if seconds is not None else float("inf"))
        with ExitStack() as stack:
            typed = stack.enter_context(KeyReader()).subscribe() if interactive() else queue.SimpleQueue[str]()
            console = Screen()
            live = Live(console=console, auto_refresh=False)
            if console.is_terminal:
                stack.enter_context(live)
            while time.monotonic() < until:
                reported = self._reported(offsets)
                for joint in self._measured:
                    ranges[joint.name].follow(reported[joint.servo])
                live.update(_rows(self._measured, ranges), refresh=console.is_terminal)
                try:
                    if typed.get(timeout=_PERIOD_S) == "enter":
                        break
                except queue.Empty:
                    continue
        if not console.is_terminal:
            console.print(_rows(self._measured, ranges))

    def _is_inverted(self, joint: Joint) -> bool:
        """Whether radians decrease as ticks increase."""
        while True:
            before = self._encoders()[joint.servo]
            wait_for_enter(f"Turn {joint.name} a little in its positive direction.", flag="no --check-signs")
            half = TICKS_PER_TURN // 2
            moved = (self._encoders()[joint.servo] - before + half) % TICKS_PER_TURN - half
            if abs(moved) >= _TURNED:
                break
            echo(f"error: {joint.name} moved by only {moved} ticks; try again", err=True)
        if moved < 0:
            echo(f"warning: {joint.name}: ticks decrease as its angle increases: it is stored as inverted", err=True)
        return moved < 0


def _rows(joints: Sequence[Joint], ranges: Mapping[str, Range]) -> Table:
    made = table(">id", "joint", ">min", ">now", ">max", ">span", "")
    for joint in joints:
        found = ranges[joint.name]
        numbers = (found.least, found.now, found.greatest, found.span)
        made.add_row(str(joint.servo), joint.name, *map(str, numbers), "crosses 0/4095" if found.crosses else "")
    return made
