"""The control loop's work, tick by tick: what a reset may undo, where the robot begins again, and in which phase."""

from __future__ import annotations

from typing import get_args

import attrs
import numpy as np
import pytest

from ibrobot_core.api import SlowDown
from ibrobot_core.control.commands import (
    PERMITTED,
    BeginStartup,
    CancelGoals,
    ChangeWorld,
    ClearFaults,
    Command,
    EmergencyStop,
    GetCounters,
    Halt,
    LimitSpeed,
    RaiseFault,
    ResetEpisode,
    SendGoal,
    SwitchMode,
)
from ibrobot_core.control.phase import TRANSITIONS, Cause, Phase
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces.hardware import Condition, Severity
from ibrobot_core.units import NS_PER_S

RELAXES = {"control": {"stop": "relax"}}
OLDER = "reset: refused, an emergency stop came after it was requested"


class TestEmergencyStops:
    def test_are_counted_and_reported_also_while_one_is_latched(self, make_rig):
        rig = make_rig({}).start()
        assert rig.tick().stops == 0
        assert rig.call(EmergencyStop())["stops"] == 1
        assert rig.call(EmergencyStop())["stops"] == 2
        assert rig.tick().stops == 2
        assert len(rig.events("fault")) == 1

    def test_are_undone_only_by_a_reset_that_knew_of_them(self, make_rig):
        rig = make_rig({}).start()
        rig.call(EmergencyStop())
        rig.call(EmergencyStop())
        assert rig.call(ClearFaults(stops=1))["error"] == OLDER
        assert rig.tick().estop
        assert "error" not in rig.call(ClearFaults(stops=2))
        assert not rig.tick().estop

    def test_that_arrive_while_the_hardware_is_reset_stay(self, make_rig):
        rig = make_rig({}).start()
        rig.call(RaiseFault(fault="a cable is loose"))
        rig.core.take_stops = lambda: rig.call(EmergencyStop())

        assert rig.call(ClearFaults())["error"] == OLDER
        assert rig.tick().estop
        assert rig.core.fault == "a cable is loose"

    def test_are_not_cleared_by_the_next_episode(self, make_rig):
        rig = make_rig({}, sim=True).start()
        assert rig.call(ResetEpisode(seed=1))["begun"]
        rig.core.take_stops = lambda: rig.call(EmergencyStop())  # arrived just before
        before = rig.tick()
        assert not rig.call(ResetEpisode(seed=2))["begun"]

        after = rig.tick(5)
        assert after.estop
        np.testing.assert_array_equal(after.command, before.command)
        rig.core.take_stops = lambda: None
        assert not rig.call(ResetEpisode(seed=2))["begun"]
        rig.call(ClearFaults())
        assert rig.call(ResetEpisode(seed=2))["begun"]

    def test_cancel_what_was_sent_before_and_refuse_what_is_sent_while_they_last(self, make_rig):
        rig = make_rig({}).start("plan")
        goal = SendGoal("arm_trajectory", "1", SlowDown())
        rig.plan([0.5, 0.5, 0.5])
        rig.call(EmergencyStop())
        assert rig.call(goal)["error"] == "refused before a reset: emergency stop"
        rig.plan([0.5, 0.5, 0.5])
        resting = rig.tick(20)
        rig.call(ClearFaults())

        np.testing.assert_allclose(rig.tick(50).command, resting.position, atol=1e-3)


class TestReset:
    @pytest.mark.parametrize("trouble", ["nan", "stale", "newer stop"])
    def test_a_refused_one_changes_nothing(self, make_rig, trouble):
        rig = make_rig(RELAXES).start()
        rig.call(EmergencyStop())
        rig.tick(20)
        for _ in range(10):  # the arm falls
            rig.hardware._position -= [0.14, 0.14, 0.0]
            rig.tick()
        if trouble == "nan":
            rig.hardware._position[2] = np.nan
        elif trouble == "stale":
            rig.hardware.stale = True
            rig.hardware.reset_faults = lambda: None
        rig.tick()
        count, generation, counters = len(rig.hardware.written), rig.core.generation, rig.core.counters()
        refused = rig.call(ClearFaults(stops=0 if trouble == "newer stop" else 1))

        assert "error" in refused
        assert rig.core.counters() == counters
        state = rig.tick(20)
        assert (state.estop, rig.core.fault, rig.core.generation) == (True, "emergency stop", generation)
        assert rig.hardware.relaxed
        assert len(rig.hardware.written) == count

    @pytest.mark.parametrize("away", [0.05, 0.59, 1.0])
    def test_the_command_begins_where_the_joint_is_whatever_it_was_before(self, make_rig, away):
        rig = make_rig({}).start()
        rig.plan([0.0, 0.0, 0.5])
        rig.tick(80)
        rig.call(RaiseFault(fault="the leader is gone"))
        rig.tick(20)
        rig.hardware.blocked[1] = True  # so that the arm stays away from its command, as one that something holds
        for _ in range(20):
            rig.hardware._position[1] -= away / 20
            rig.tick()
        assert "error" not in rig.call(ClearFaults())

        positions = [rig.tick() for _ in range(30)]
        np.testing.assert_allclose(positions[0].command, positions[0].position, atol=1e-3)
        np.testing.assert_allclose(positions[-1].command, positions[0].command, atol=1e-9)

    def test_a_reading_that_no_other_confirms_is_not_where_the_command_begins(self, make_rig, monkeypatch):
        rig = make_rig({}).start()
        rig.call(EmergencyStop())
        resting = rig.tick(20)
        read, readings = rig.hardware.read, []

        def wild():
            reading = read()
            readings.append(reading)
            if len(readings) == 1:
                reading.position[0] += 0.9
            return reading

        monkeypatch.setattr(rig.hardware, "read", wild)
        assert "error" not in rig.call(ClearFaults())
        np.testing.assert_allclose(rig.tick().command, resting.position, atol=1e-3)


class TestReadings:
    @pytest.mark.parametrize("jump", [1.8, -3.0, 1e6])
    def test_a_wild_one_moves_nothing(self, make_rig, jump):
        rig, undisturbed = make_rig({}).start(), make_rig({}).start()
        for tick in range(60):
            for each in (rig, undisturbed):
                if tick % 20 == 0:
                    each.plan([0.4, 0.4, 0.9])
            wild = tick % 10 == 5
            rig.hardware._position[1] += jump if wild else 0.0
            command = rig.tick().command
            rig.hardware._position = undisturbed.hardware._position
            np.testing.assert_array_equal(command, undisturbed.tick().command)
            rig.hardware._position = undisturbed.hardware._position.copy()

        assert rig.core.fault == ""
        assert rig.core.counters()["loop"]["implausible_states"] == 6

    def test_a_jump_that_lasts_is_a_fault_and_a_reset_accepts_it(self, make_rig):
        rig = make_rig({}).start()
        before = rig.tick(10)
        rig.hardware.blocked[:] = True
        rig.hardware._position[1] += 1.2
        state = rig.tick(5)

        assert "joint lift is measured 1.20 rad away from where it was, which is not believed" in rig.core.fault
        np.testing.assert_array_equal(state.command, before.command)
        assert "error" not in rig.call(ClearFaults())
        state = rig.tick()
        np.testing.assert_allclose(state.command, rig.hardware._position)
        assert rig.core.fault == ""

    @pytest.mark.parametrize("stop", [False, True], ids=["fault", "STOP"])
    @pytest.mark.parametrize("lie", [-3.0, -0.8, 0.8, 1.0, 1.5, 3.0])
    def test_a_lie_is_not_believed_however_long_it_lasts(self, make_rig, lie, stop):
        """The arm follows its command, and each reading is off by the lie: believed once, it would drive the arm."""
        rig = make_rig({}).start()
        before = rig.tick(10)
        if stop:
            rig.call(EmergencyStop())
        for _ in range(300):
            rig.hardware._position = before.command + np.array([0.0, lie, 0.0])
            state = rig.tick()
            np.testing.assert_allclose(state.command, before.command, atol=1e-9)

        assert rig.core.fault

    @pytest.mark.parametrize("ahead_s", [0.0, 0.5, 3600.0])
    def test_silence_is_noticed_whatever_the_clock_of_the_hardware(self, make_rig, ahead_s):
        rig = make_rig({}).start()
        read = rig.hardware.read
        last = [read()]

        def stamped():
            reading = attrs.evolve(read(), stamp_ns=rig.clock.now_ns() + int(ahead_s * 1e9))
            return attrs.evolve(reading, stale=True, stamp_ns=last[0].stamp_ns) if rig.silent else reading

        rig.silent = False
        rig.hardware.read = stamped
        rig.tick(5)
        last[0] = stamped()
        rig.silent = True
        rig.tick(30)

        assert "the joints do not answer: no state for" in rig.core.fault

    def test_an_arm_that_is_struck_is_believed(self, make_rig):
        rig = make_rig({}).start()
        rig.hardware.blocked[:] = True
        for _ in range(3):
            rig.hardware._position[1] += 0.19
            rig.tick()

        assert rig.core.counters()["loop"]["implausible_states"] == 0


class TestFaults:
    @pytest.mark.parametrize("text", ["", "  \n"])
    def test_one_without_a_message_is_latched(self, make_rig, text):
        rig = make_rig({}).start()
        rig.call(RaiseFault(fault=text))

        assert rig.core.fault == "a fault without a message"
        assert "error" in rig.call(SwitchMode(mode="plan"))

    def test_an_error_of_the_hardware_without_a_message_is_latched(self, make_rig, monkeypatch):
        rig = make_rig({}).start()

        def read():
            raise HardwareError

        monkeypatch.setattr(rig.hardware, "read", read)
        rig.tick()
        assert rig.core.fault == "a fault without a message"

    def test_a_suspended_computer_is_one_and_what_was_planned_before_is_not_followed(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 2.0)
        rig.tick(50)
        rig.clock.suspend(90 * NS_PER_S)
        rig.plan([0.9, 1.0, 0.9], 2.0)
        state = rig.tick(10)

        assert rig.core.fault == "the computer was suspended for 90.0 s"
        rig.tick(50)
        np.testing.assert_array_equal(rig.core.state.command, state.command)
        rig.assert_within_limits()
        rig.call(ClearFaults())
        np.testing.assert_allclose(rig.tick(50).command, state.command, atol=0.01)
        assert rig.core.fault == ""

    @pytest.mark.parametrize("error", [OverflowError, ZeroDivisionError, KeyError, AttributeError, ValueError])
    def test_a_goal_with_which_an_executor_cannot_cope_is_refused(self, make_rig, monkeypatch, error):
        rig = make_rig({}).start("plan")

        def set_goal(*arguments):
            raise error("int too large to convert to float")

        executor = rig.core._executors._all["arm_trajectory"].executor
        monkeypatch.setattr(type(executor), "set_goal", set_goal)
        answer = rig.call(SendGoal(executor="arm_trajectory", goal_id="1", goal=SlowDown()))
        assert "arm_trajectory: the goal is malformed: " in answer["error"]
        rig.tick(10)


HOT = Condition("lift", "temperature", 58.0, "deg C", Severity.WARNING, "lift is at 58 deg C", sheds_load=True)


def into(make_rig, phase: Phase):
    """A robot in a phase."""
    shedding = {"after": 0.2, "pose": "rest"}
    rig = make_rig({"control": {"startup": "pose rest", "stop": "pose rest", "load_shedding": shedding}}, sim=True)
    rig.core.start("stream")
    rig.hardware.written.append(rig.hardware.read().position)
    rig.tick(5)
    if phase is Phase.FAILED:
        rig.call(RaiseFault(fault="a cable is loose"))
    elif phase is not Phase.ARRIVING:
        rig.call(BeginStartup())
        rig.tick_until(rig.core.arrived)
    if phase is Phase.FAULTED:
        rig.call(RaiseFault(fault="a cable is loose"))
    if phase in {Phase.SHEDDING, Phase.SHED}:
        rig.plan([0.4, 0.4, 0.9])
        rig.tick(50)
        rig.hardware.conditions = (HOT,)
        rig.tick_until(lambda: rig.core.phase is phase)
        rig.hardware.conditions = ()
    if phase is Phase.STOPPING:
        rig.core.begin_stop()
    assert rig.core.phase is phase
    return rig


COMMANDS: tuple[Command, ...] = (
    SwitchMode("plan"),
    SendGoal("arm_trajectory", "1", SlowDown()),
    ClearFaults(),
    ResetEpisode(1),
    CancelGoals(),
    GetCounters(),
    RaiseFault("the leader is gone"),
    EmergencyStop(),
    Halt(),
    BeginStartup(),
    ChangeWorld({}),
    LimitSpeed(0.5),
)
CAUSES = {
    EmergencyStop: Cause.EMERGENCY_STOP,
    RaiseFault: Cause.FAULT,
    ClearFaults: Cause.RESET,
    ResetEpisode: Cause.RESET,
    Halt: Cause.STOP,
}
BRAKING = {(Phase.SHEDDING, ClearFaults)}
"""Refused since the robot moves."""


class TestPhases:
    @pytest.mark.parametrize("command", COMMANDS, ids=lambda command: type(command).__name__)
    @pytest.mark.parametrize("phase", Phase)
    def test_each_permits_its_commands_and_goes_where_they_lead(self, make_rig, phase, command):
        rig = into(make_rig, phase)
        answer, kind = rig.call(command), type(command)
        if phase in PERMITTED.get(kind, Phase) and (phase, kind) not in BRAKING:
            assert "refused" not in answer.get("error", "")
            after = TRANSITIONS[phase].get(CAUSES[kind], phase) if kind in CAUSES else phase
        else:
            assert answer["error"].startswith((f"refused {phase.value}", "the robot is still braking"))
            after = phase
        assert rig.core.phase is after

    def test_every_command_has_a_place(self, make_rig):
        assert set(make_rig({}).core._acts) == {type(each) for each in COMMANDS} == set(get_args(Command))

    @pytest.mark.parametrize("phase", Phase)
    def test_an_emergency_stop_brakes_and_holds_in_each(self, make_rig, phase):
        rig = into(make_rig, phase)
        rig.plan([0.4, 0.4, 0.9])
        rig.tick(8)
        rig.call(EmergencyStop())
        braked = rig.tick(10)
        rig.plan([0.9, 0.9, 0.9])

        assert braked.estop
        np.testing.assert_array_equal(rig.tick(50).command, braked.command)
        rig.assert_within_limits()
        assert rig.core.stopped
