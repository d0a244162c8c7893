"""The teleop suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_testing import TeleopSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeTeleop

from ibrobot_core.api import TeleopError, seconds


class TestTeleop(TeleopSuite):
    @override
    def make(self, ctx):
        return FakeTeleop(ctx)

    @override
    def engage(self, teleop):
        teleop.silent = False
        teleop.press()

    @override
    def release(self, teleop):
        teleop.pressed = False

    @override
    def operate(self, teleop):
        teleop.velocity = 0.1

    @override
    def hold(self, teleop):
        teleop.pressed, teleop.silent, teleop.velocity = True, False, 0.1

    @override
    def freeze(self, teleop):
        teleop.silent = True

    events = ("success", "intervention")

    @override
    def press(self, teleop, event):
        teleop.events = (event,)


class BeginsAtZero(FakeTeleop):
    def press(self):
        super().press()
        self._positions = np.zeros_like(self._positions)


class BeginsWhereItFirstBegan(FakeTeleop):
    first = None

    def press(self):
        super().press()
        self.first = self._positions if self.first is None else self.first
        self._positions = self.first


class UnknownJoint(FakeTeleop):
    def read(self, measured):
        command = super().read(measured)
        positions = command.positions and {f"leader_{joint}": p for joint, p in command.positions.items()}
        return attrs.evolve(command, positions=positions)


class NotANumber(FakeTeleop):
    def read(self, measured):
        command = super().read(measured)
        return attrs.evolve(command, positions=command.positions and dict.fromkeys(command.positions, np.nan))


class NeverMoves(FakeTeleop):
    def read(self, measured):
        self.velocity = 0.0
        return super().read(measured)


class IgnoresTheDeadman(FakeTeleop):
    def read(self, measured):
        self.pressed = True
        return super().read(measured)


class PressesByItself(FakeTeleop):
    def read(self, measured):
        self.press()
        return super().read(measured)


class MovesOnWhileItMayNot(FakeTeleop):
    def read(self, measured):
        before, since_ns = self._positions, self._last_ns
        command = super().read(measured)
        self._positions = before + self.velocity * seconds(measured.stamp_ns - since_ns)
        return command


class RepeatsOldReports(FakeTeleop):
    def read(self, measured):
        self.silent = False
        return super().read(measured)


class MakesUpForMissedTicks(FakeTeleop):
    def read(self, measured):
        for now_ns in range(max(self._last_ns, measured.stamp_ns - 5_000_000_000), measured.stamp_ns, 10_000_000):
            self.deadman.report(self.pressed, now_ns)
            self.deadman.allows(now_ns)
        return super().read(measured)


class KeepsTheMeasurement(FakeTeleop):
    def read(self, measured):
        command = super().read(measured)
        if command.positions is None:
            self._positions = measured.position
        return command


class ChangesTheMeasurement(FakeTeleop):
    def read(self, measured):
        command = super().read(measured)
        measured.position[:] = 0.0
        return command


class StaysPressed(FakeTeleop):
    def read(self, measured):
        pressed = self.events
        command = super().read(measured)
        self.events = pressed
        return command


class NeverArrives(FakeTeleop):
    def approach(self, measured):
        return False


class DisconnectsOnce(FakeTeleop):
    def disconnect(self):
        if not self._open:
            raise TeleopError("not connected")
        super().disconnect()


class ReadsWhileDisconnected(FakeTeleop):
    def read(self, measured):
        self._open = True
        return super().read(measured)


class OpenFromTheBeginning(FakeTeleop):
    def __init__(self, ctx):
        super().__init__(ctx)
        self._open = True


class PressesAButtonByItself(FakeTeleop):
    """Reports a button as soon as it is activated."""

    def activate(self, measured):
        super().activate(measured)
        self.own = 2

    def read(self, measured):
        command = super().read(measured)
        self.own -= 1
        return attrs.evolve(command, events=("intervention",)) if self.own == 0 else command


WRONG = {
    BeginsAtZero: "begins_where_the_robot_is",
    BeginsWhereItFirstBegan: "begins_where_the_robot_is",
    UnknownJoint: "positions_are_of_known_joints",
    NotANumber: "positions_are_of_known_joints",
    NeverMoves: "operating_moves",
    IgnoresTheDeadman: "released_deadman_gives_none",
    PressesByItself: "waits_for_the_operator",
    MovesOnWhileItMayNot: "a_held_deadman_does_not_survive_an_activation",
    RepeatsOldReports: "silence_ends_motion",
    MakesUpForMissedTicks: "a_pause_of_the_host_ends_motion",
    KeepsTheMeasurement: "leaves_the_measurement_alone",
    ChangesTheMeasurement: "leaves_the_measurement_alone",
    StaysPressed: "each_press_is_one_event",
    NeverArrives: "approach_arrives",
    DisconnectsOnce: "disconnect_is_safe_at_any_time",
    OpenFromTheBeginning: "refuses_reading_while_disconnected",
    PressesAButtonByItself: "each_press_is_one_event",
    ReadsWhileDisconnected: "refuses_reading_while_disconnected",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestTeleop):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_button_of_an_unknown_event_is_refused(tmp_path):
    class Suite(TestTeleop):
        events = ("success", "jump")  # type: ignore[assignment]

    assert failed_checks(Suite, tmp_path) == {"each_press_is_one_event"}


def test_every_check_catches_something():
    assert checks(TeleopSuite) == set(WRONG.values())
