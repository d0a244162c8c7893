"""The hardware suites pass the fakes, and each of their checks catches something wrong."""

from __future__ import annotations

import time
from typing import Any, ClassVar, override

import numpy as np
import pytest
from ibrobot_testing import HardwareSuite, SimulatedHardwareSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeHardware, FakeRealHardware

from ibrobot_core.api import Condition, EpisodeSetup, HardwareError, Holding, JointReading, Severity, Signal, Torque


class TestRealHardware(HardwareSuite):
    @override
    def make(self, ctx):
        return FakeRealHardware(ctx)


class Device(FakeHardware):
    """A fake whose device has torque of its own, may fall silent, be unplugged, or be blocked."""

    torque = silent = unplugged = False
    stalled = -1
    answer = None

    def connect(self):
        super().connect()
        self.torque = True

    def write(self, position):
        super().write(position)
        self.torque = True

    def relax(self):
        self.torque = False
        return super().relax()

    def holding(self):
        return Holding("the device", "torque off") if self.torque else None

    def undo_connect(self):
        self.torque = False

    def read(self):
        if self.unplugged:
            raise HardwareError("the device is gone")
        if not self.silent:
            self.answer = super().read()
        return self.answer

    def advance(self, step_ns):
        blocked = self._position[self.stalled]
        super().advance(step_ns)
        if self.stalled >= 0:
            self._position[self.stalled] = blocked


class TestSimulatedHardware(SimulatedHardwareSuite):
    @override
    def make(self, ctx):
        return Device(ctx)

    @override
    def has_torque(self, hardware):
        return hardware.torque

    @override
    def lose_replies(self, hardware):
        hardware.silent = True

    @override
    def unplug(self, hardware):
        hardware.unplugged = True

    @override
    def stall(self, hardware, joint):
        hardware.stalled = joint


class OtherJoints(Device):
    def __init__(self, ctx):
        super().__init__(ctx)
        self.joints = ctx.joints[::-1]


class ShortVelocity(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, r.position, r.velocity[1:], r.effort)


class NotANumber(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, np.full_like(r.position, np.nan), r.velocity, r.effort)


class StampsStandStill(Device):
    def read(self):
        r = super().read()
        return JointReading(1, r.position, r.velocity, r.effort)


class StampsAhead(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns + 10**9, r.position, r.velocity, r.effort)


class DriftsToZero(Device):
    def advance(self, step_ns):
        super().advance(step_ns)
        self._command = self._command * 0.98


class HomesOnConnect(Device):
    def connect(self):
        super().connect()
        self._command = np.zeros_like(self._command)


class IgnoresCommands(Device):
    def write(self, position):
        command = self._command
        super().write(position)
        self._command = command


class SwapsJoints(Device):
    def write(self, position):
        super().write(position[::-1] if position.shape == self._position.shape else position)


class Degrees(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, np.degrees(r.position), np.degrees(r.velocity), r.effort)


class BroadcastsCommands(Device):
    def write(self, position):
        super().write(np.resize(position, self._position.shape))


class KeepsTheCommand(Device):
    def write(self, position):
        super().write(position)
        self._command = position


class ReusesItsReading(Device):
    def read(self):
        r = super().read()
        self._buffer = getattr(self, "_buffer", r.position)
        self._buffer[:] = r.position
        return JointReading(r.stamp_ns, self._buffer, r.velocity, r.effort)


class DisconnectsOnce(Device):
    def disconnect(self):
        self._check_open()
        super().disconnect()


class ReadsWhileDisconnected(Device):
    def _check_open(self):
        pass


class ReadsBeforeItIsConnected(Device):
    def __init__(self, ctx):
        super().__init__(ctx)
        self._open = True


class StaysRelaxed(Device):
    def write(self, position):
        relaxed = self.relaxed
        super().write(position)
        self.relaxed = relaxed


class RelaxReportsNothing(Device):
    def relax(self):
        super().relax()


class HoldsOnAfterRelax(Device):
    def holding(self):
        return Holding("somewhere", "torque off") if self._open else None


class NamesNoCommand(Device):
    def holding(self):
        return Holding("somewhere", "") if self._open and not self.relaxed else None


class ForgetsWhatHolds(Device):
    """Holds while it is connected only: but torque stays on when the port is released."""

    def holding(self):
        return Holding("somewhere", "torque off") if self._open and not self.relaxed else None


class LeavesTorqueOn(Device):
    on = False

    def connect(self):
        super().connect()
        self.on = True

    def holding(self):
        return Holding("somewhere", "torque off") if self.on and not self.relaxed else None

    def undo_connect(self):
        pass


class ConditionOfAnUnknownJoint(Device):
    def health(self):
        return (Condition("nose", "temperature", 70.0, "deg C", Severity.FAULT, "nose is hot: let it cool"),)


class ConditionWithoutAValue(Device):
    def health(self):
        joint = self.joints[0]
        return (Condition(joint, "voltage", np.nan, "V", Severity.WARNING, f"{joint} has no voltage: see its cable"),)


class ConditionTwice(Device):
    def health(self):
        hot = Condition(self.joints[0], "temperature", 70.0, "deg C", Severity.FAULT, f"{self.joints[0]} is hot")
        return (hot, hot)


class ResetFaultsHomes(Device):
    def reset_faults(self):
        self._command = np.zeros_like(self._command)


class ShortSignal(Device):
    signals = (Signal("/fake/command", 3),)

    def read_signal(self, index, out):
        out[0] = 1.0


class MovesWithoutAdvance(Device):
    def read(self):
        self.advance(1_000_000)
        return super().read()


class RandomFriction(Device):
    random: ClassVar = np.random.default_rng()

    def advance(self, step_ns):
        super().advance(step_ns)
        self._position = self._position + self.random.normal(0, 1e-9, self._position.shape)


class SeedFromTheObject(Device):
    def reset(self, episode):
        super().reset(EpisodeSetup(episode.seed + id(self)))


class RemembersTheCommand(Device):
    def reset(self, episode):
        command = getattr(self, "_command", None)
        super().reset(episode)
        if command is not None:
            self._command = command


class AlwaysSucceeds(Device):
    def success(self):
        return True


class LimitsItself(Device):
    """Correct in all but this: it raises for what the safety layer let pass."""

    def write(self, position):
        if np.abs(position).max() > 0.01:
            raise HardwareError("too far")
        super().write(position)


class TorqueByWayOfZero(Device):
    """The goal register has zero while torque is off, and the joints are pulled there until the command arrives."""

    back = 0

    def write(self, position):
        self.back = 5 if self.relaxed else self.back
        super().write(position)

    def advance(self, step_ns):
        command = self._command
        if self.back:
            self.back, self._command = self.back - 1, np.zeros_like(command)
        super().advance(step_ns)
        self._command = command


class RepeatsALostReply(Device):
    """Of fast joints, every seventh reading has the positions of the one before, and a new stamp."""

    number = 0
    last = np.zeros(0)

    def reset(self, episode):
        super().reset(episode)
        self.number = 0

    def read(self):
        r = super().read()
        self.number += 1
        if self.number % 14 not in (0, 1) or np.abs(r.velocity).max() < 0.5:
            self.last = r.position
        return JointReading(r.stamp_ns, self.last.copy(), r.velocity, r.effort)


class RepeatsATick(Device):
    """Of fast joints, all readings of every seventh tick have the positions of the tick before, and a new stamp."""

    stamp_ns = ticks = 0
    now = before = np.zeros(0)

    def reset(self, episode):
        super().reset(episode)
        self.stamp_ns, self.ticks = -1, 0

    def read(self):
        r = super().read()
        if r.stamp_ns != self.stamp_ns:
            self.stamp_ns, self.ticks, self.before = r.stamp_ns, self.ticks + 1, self.now
        repeats = self.ticks % 7 == 6 and np.abs(r.velocity).max() >= 0.5
        self.now = self.before if repeats else r.position
        return JointReading(r.stamp_ns, self.now.copy(), r.velocity, r.effort)


class AlwaysStale(Device):
    """Each reading is that of the tick before, as from a queue that nobody empties."""

    queue: Any = ()

    def read(self):
        r = super().read()
        self.queue = (*self.queue, r.position)[-2:]
        return JointReading(r.stamp_ns, self.queue[0].copy(), r.velocity, r.effort)


class FallsOnDisconnect(Device):
    def disconnect(self):
        super().disconnect()
        self.torque = False

    def holding(self):
        return Holding("the device", "torque off") if not self.relaxed and hasattr(self, "_command") else None


class RelaxesInNameOnly(Device):
    def relax(self):
        super().relax()
        self.torque = True
        return Torque.OFF


class NewStampWithoutAReply(Device):
    def read(self):
        r = super().read()
        return JointReading(self._ctx.clock.now_ns(), r.position, r.velocity, r.effort)


class GoesOnUnplugged(Device):
    def read(self):
        self.unplugged = False
        return super().read()


class ReportsItsCommands(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, self._command.copy(), r.velocity, r.effort)


class NoVelocity(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, r.position, np.zeros_like(r.velocity), r.effort)


class NegativeVelocity(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, r.position, -r.velocity, r.effort)


class VelocityInDegrees(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, r.position, np.degrees(r.velocity), r.effort)


class EffortOfZero(Device):
    def read(self):
        r = super().read()
        return JointReading(r.stamp_ns, r.position, r.velocity, np.zeros_like(r.effort))


class ClampsCommands(Device):
    def write(self, position):
        super().write(position)
        self._command = np.clip(position, -0.5, 0.5)


class BlocksInRead(Device):
    def read(self):
        time.sleep(0.05)
        return super().read()


class BlocksInWrite(Device):
    def write(self, position):
        super().write(position)
        time.sleep(0.02)


WRONG = {
    FallsOnDisconnect: "the_device_keeps_its_torque_when_it_is_disconnected",
    RelaxesInNameOnly: "the_device_loses_torque_with_relax_and_has_it_with_the_next_write",
    NewStampWithoutAReply: "a_lost_reply_is_no_new_reading",
    GoesOnUnplugged: "an_unplugged_device_is_an_error",
    ReportsItsCommands: "a_blocked_joint_is_measured_where_it_is",
    NoVelocity: "velocity_is_that_of_the_motion",
    NegativeVelocity: "velocity_is_that_of_the_motion",
    VelocityInDegrees: "velocity_is_that_of_the_motion",
    EffortOfZero: "effort_is_measured_or_missing",
    ClampsCommands: "reaches_the_ends_of_the_way",
    TorqueByWayOfZero: "torque_returns_without_a_jump",
    RepeatsALostReply: "readings_are_new",
    RepeatsATick: "readings_are_new",
    AlwaysStale: "readings_are_new",
    BlocksInWrite: "reading_fits_into_a_control_period",
    OtherJoints: "owns_the_joints_it_was_given",
    ShortVelocity: "reading_is_complete",
    NotANumber: "reading_is_complete",
    StampsStandStill: "stamps_follow_the_clock",
    StampsAhead: "stamps_follow_the_clock",
    DriftsToZero: "holds_where_it_is",
    HomesOnConnect: "connecting_moves_nothing",
    IgnoresCommands: "write_moves_each_joint_towards_its_command",
    SwapsJoints: "write_moves_each_joint_towards_its_command",
    Degrees: "write_moves_each_joint_towards_its_command",
    LimitsItself: "write_moves_each_joint_towards_its_command",
    BroadcastsCommands: "refuses_a_command_of_wrong_shape",
    KeepsTheCommand: "keeps_no_hold_of_the_callers_arrays",
    ReusesItsReading: "keeps_no_hold_of_the_callers_arrays",
    DisconnectsOnce: "disconnect_is_safe_at_any_time",
    ReadsBeforeItIsConnected: "refuses_use_while_disconnected",
    ReadsWhileDisconnected: "refuses_use_while_disconnected",
    StaysRelaxed: "relax_ends_with_the_next_write",
    RelaxReportsNothing: "relax_reports_torque_and_what_holds_it",
    HoldsOnAfterRelax: "relax_reports_torque_and_what_holds_it",
    NamesNoCommand: "relax_reports_torque_and_what_holds_it",
    ForgetsWhatHolds: "holding_is_known_while_disconnected",
    LeavesTorqueOn: "undone_connect_leaves_no_torque_of_its_own",
    ConditionOfAnUnknownJoint: "conditions_are_of_its_joints",
    ConditionWithoutAValue: "conditions_are_of_its_joints",
    ConditionTwice: "conditions_are_of_its_joints",
    ResetFaultsHomes: "reset_faults_moves_nothing",
    ShortSignal: "signals_fill_their_vectors",
    MovesWithoutAdvance: "time_passes_only_by_advance",
    RandomFriction: "equal_seeds_run_alike",
    SeedFromTheObject: "equal_seeds_run_alike_in_another_object",
    RemembersTheCommand: "reset_holds",
    AlwaysSucceeds: "success_is_a_verdict",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestSimulatedHardware):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_catches_a_read_that_blocks(tmp_path):
    """Only this check is run: the others would take minutes with it."""

    class Suite(TestSimulatedHardware):
        @override
        def make(self, ctx):
            return BlocksInRead(ctx)

    with pytest.raises(AssertionError, match=r"read takes 0\.05"):
        Suite().test_reading_fits_into_a_control_period()


ALONE = {
    TorqueByWayOfZero: "torque_returns_without_a_jump",
    RepeatsALostReply: "readings_are_new",
    RepeatsATick: "readings_are_new",
    BlocksInWrite: "reading_fits_into_a_control_period",
}


@pytest.mark.parametrize(("wrong", "caught_by"), ALONE.items(), ids=lambda v: getattr(v, "__name__", v))
def test_no_other_check_catches(wrong, caught_by, tmp_path):
    class Suite(TestSimulatedHardware):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert set(failed_checks(Suite, tmp_path)) == {caught_by}


def test_every_check_catches_something():
    assert checks(SimulatedHardwareSuite) == set(WRONG.values())
