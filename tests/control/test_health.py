"""What is wrong with the joints, in the control loop: warnings, faults, and load that is shed."""

from __future__ import annotations

import json
import logging

import attrs
import numpy as np
import pytest

from ibrobot_core.control.commands import ClearFaults, EmergencyStop
from ibrobot_core.errors import ConfigError, HardwareError
from ibrobot_core.interfaces.hardware import Condition, Severity

HOT = Condition(
    "lift", "temperature", 58.0, "deg C", Severity.WARNING, "lift is at 58 deg C, above 55: let it rest", True
)
WEAK = Condition("pan", "voltage", 5.1, "V", Severity.WARNING, "pan has 5.1 V, below 6: check the supply")
SHED = {"control": {"load_shedding": {"after": 1.0, "pose": "rest"}}}
REST = [-0.8, 1.0, 0.1]


def assert_at_rest(rig) -> None:
    """The last command moved no joint, and nothing before it broke a limit."""
    np.testing.assert_array_equal(rig.hardware.written[-1], rig.hardware.written[-2])
    rig.assert_within_limits()


def worse(condition: Condition) -> Condition:
    return attrs.evolve(condition, severity=Severity.FAULT)


class TestWarnings:
    def test_are_logged_once_when_they_begin(self, make_rig, caplog):
        rig = make_rig({}).start()
        for temperature in (58.0, 58.5, 59.0):
            rig.hardware.conditions = (attrs.evolve(HOT, value=temperature), WEAK)
            rig.tick(50)
        assert [r.message for r in caplog.records if r.levelno == logging.WARNING] == [HOT.message, WEAK.message]

        rig.hardware.conditions = (WEAK,)
        rig.tick()
        rig.hardware.conditions = (WEAK, HOT)
        rig.tick()
        assert [r.message for r in caplog.records].count(HOT.message) == 2
        assert rig.core.fault == ""

    def test_are_among_the_counters_as_plain_data(self, make_rig):
        rig = make_rig({}).start()
        assert rig.core.counters()["conditions"] == []
        rig.hardware.conditions = (HOT,)
        rig.tick()

        (reported,) = json.loads(json.dumps(rig.core.counters()))["conditions"]
        assert reported["joint"] == "lift"
        assert reported["severity"] == "warning"
        assert reported["value"] == 58.0
        rig.hardware.conditions = ()
        rig.tick()
        assert rig.core.counters()["conditions"] == []

    def test_of_all_parts_are_reported(self, make_rig):
        hardware = {
            "hand": {"type": "scripted", "joints": ["grip", "lift"]},
            "base": {"type": "scripted", "joints": ["pan"]},
        }
        rig = make_rig({"hardware": hardware}).start()
        rig.parts["hand"].conditions, rig.parts["base"].conditions = (HOT,), (WEAK,)
        rig.tick()
        rig.core.close()

        assert [each["joint"] for each in rig.core.counters()["conditions"]] == ["lift", "pan"]


class TestFaults:
    def test_stop_the_robot_until_a_reset_finds_them_gone(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9])
        rig.tick(10)
        rig.hardware.conditions = (HOT, worse(WEAK))
        rig.tick(20)
        assert rig.core.fault == WEAK.message
        assert [event["fault"] for event in rig.events("fault")] == [WEAK.message]
        rig.assert_within_limits()

        rig.call(ClearFaults())
        rig.tick()
        assert rig.core.fault == WEAK.message  # it lasts
        rig.hardware.conditions = ()
        rig.tick()
        assert "error" not in rig.call(ClearFaults())
        rig.tick()
        assert rig.core.fault == ""

    def test_relax_where_that_is_the_stop(self, make_rig):
        rig = make_rig({"control": {"stop": "relax"}}).start()
        rig.hardware.conditions = (worse(HOT),)
        rig.tick()

        assert rig.hardware.relaxed


class TestShedding:
    def test_moves_to_the_pose_and_then_relaxes(self, make_rig):
        rig = make_rig(SHED).start()
        rig.hardware.conditions = (HOT,)
        rig.tick(100)
        assert rig.core.fault == ""
        rig.tick()
        (event,) = rig.events("fault")
        assert event["fault"] == f"{HOT.message}; this has lasted for 1 s"
        assert event["then"] == "goes to pose rest and relaxes"
        assert not rig.hardware.relaxed

        rig.tick(800)
        np.testing.assert_allclose(rig.hardware.written[-1], REST, atol=1e-3)
        assert rig.hardware.relaxed
        rig.assert_within_limits()

    @pytest.mark.parametrize("pose", ["", "rest"])
    def test_without_a_pose_or_after_an_emergency_stop_it_relaxes_at_once(self, make_rig, pose):
        rig = make_rig({"control": {"load_shedding": {"after": 1.0, "pose": pose}}}).start()
        if pose:
            rig.call(EmergencyStop())
        before = rig.tick().command
        rig.hardware.conditions = (HOT,)
        rig.tick(102)

        assert rig.hardware.relaxed
        np.testing.assert_array_equal(rig.hardware.written[-1], before)
        assert rig.events("fault")[-1]["then"] == "relaxes"

    def test_follows_a_fault_of_the_same_kind(self, make_rig):
        rig = make_rig(SHED).start()
        rig.hardware.conditions = (worse(HOT),)
        rig.tick(10)
        assert rig.core.fault == HOT.message
        rig.hardware.conditions = (attrs.evolve(worse(HOT), message="hotter still"),)
        rig.tick(900)

        np.testing.assert_allclose(rig.hardware.written[-1], REST, atol=1e-3)
        assert rig.hardware.relaxed

    def test_is_not_for_what_it_does_not_help_nor_for_what_passes(self, make_rig):
        rig = make_rig(SHED).start()
        for _ in range(4):
            rig.hardware.conditions = (HOT, WEAK)
            rig.tick(90)
            rig.hardware.conditions = (WEAK,)
            rig.tick()

        assert rig.core.fault == ""

    def test_a_reset_gives_it_its_time_again(self, make_rig):
        rig = make_rig({"control": {"load_shedding": {"after": 1.0}}}).start()
        rig.hardware.conditions = (HOT,)
        rig.tick(110)
        assert rig.hardware.relaxed

        assert "error" not in rig.call(ClearFaults())
        rig.tick(90)
        assert not rig.hardware.relaxed
        rig.tick(20)
        assert rig.hardware.relaxed

    def test_a_blocked_way_to_the_pose_ends_in_relaxing(self, make_rig):
        rig = make_rig(SHED).start()
        rig.hardware.blocked[:] = True
        rig.hardware.conditions = (HOT,)
        rig.tick(1150)

        assert rig.hardware.relaxed

    def test_torque_that_stays_on_is_reported_once(self, make_rig):
        rig = make_rig({"control": {"load_shedding": {"after": 1.0}}}).start()
        rig.hardware.relax_outcome = HardwareError("servo 2 keeps it")
        rig.hardware.conditions = (HOT,)
        rig.tick(200)

        assert [event["fault"] for event in rig.events("fault")] == [
            f"{HOT.message}; this has lasted for 1 s",
            "torque of hardware cannot be taken off: servo 2 keeps it",
        ]

    def test_on_the_way_silence_brakes_and_then_relaxes(self, make_rig):
        rig = make_rig(SHED).start()
        rig.hardware.conditions = (HOT,)
        rig.tick(120)
        assert np.abs(rig.hardware.written[-1] - rig.hardware.written[-2]).max() > 0.004
        rig.hardware.stale = True
        rig.tick(12)

        assert rig.hardware.relaxed
        assert np.abs(rig.hardware.written[-1] - REST).max() > 0.1
        assert_at_rest(rig)

    def test_on_the_way_an_emergency_stop_brakes_and_holds_until_the_load_has_had_its_time_again(self, make_rig):
        rig = make_rig(SHED).start()
        rig.hardware.conditions = (HOT,)
        rig.tick(120)
        assert np.abs(rig.hardware.written[-1] - rig.hardware.written[-2]).max() > 0.004
        rig.call(EmergencyStop())
        rig.tick(95)
        assert not rig.hardware.relaxed
        assert np.abs(rig.hardware.written[-1] - REST).max() > 0.1
        assert_at_rest(rig)

        rig.tick(10)
        assert rig.hardware.relaxed
        assert rig.events("fault")[-1]["then"] == "relaxes"

    def test_on_the_move_and_without_a_pose_it_brakes_before_it_relaxes(self, make_rig):
        rig = make_rig({"control": {"load_shedding": {"after": 0.2}}}).start()
        rig.hardware.conditions = (HOT,)
        rig.plan([0.9, 1.0, 0.9], 0.6)
        rig.tick(40)

        assert rig.hardware.relaxed
        assert_at_rest(rig)

    def test_its_pose_must_be_there(self, make_rig):
        with pytest.raises(ConfigError, match=r"control\.load_shedding\.pose"):
            make_rig({"control": {"load_shedding": {"pose": "bed"}}})


class TestHolding:
    TWO = {  # noqa: RUF012 - a document
        "hand": {"type": "scripted", "joints": ["grip", "lift"]},
        "base": {"type": "scripted", "joints": ["pan"]},
    }

    def test_is_reported_with_what_takes_it_off(self, make_rig):
        rig = make_rig({}).start()
        rig.stop()
        rig.core.close()

        assert rig.core.holding() == ["hardware holds torque; to take it off: `scripted off hardware`"]

    def test_nothing_holds_after_relax(self, make_rig):
        rig = make_rig({"control": {"stop": "relax"}}).start()
        rig.stop()

        assert rig.core.holding() == []

    def test_where_a_part_does_not_connect_the_others_do_not_hold(self, make_rig):
        rig = make_rig({"hardware": self.TWO})
        rig.parts["base"].connect_error = "no such port"
        with pytest.raises(HardwareError, match="base: no such port"):
            rig.core.start("stream")

        assert not rig.parts["hand"].torque
        assert rig.core.holding() == []

    def test_torque_that_cannot_be_undone_is_reported(self, make_rig, caplog):
        rig = make_rig({"hardware": self.TWO})
        rig.parts["base"].connect_error = "no such port"
        rig.parts["hand"].relax_outcome = HardwareError("servo 6 keeps it")
        with pytest.raises(HardwareError, match="base: no such port"):
            rig.core.start("stream")

        assert "torque of hand cannot be taken off: servo 6 keeps it" in caplog.text
        assert rig.core.holding() == ["hand holds torque; to take it off: `scripted off hand`"]

    def test_a_start_without_a_first_reading_does_not_hold(self, make_rig):
        rig = make_rig({})
        rig.hardware.silent = True
        with pytest.raises(HardwareError, match="the bus is silent"):
            rig.core.start("stream")

        assert not rig.hardware.torque

    @pytest.mark.parametrize(("startup", "torque"), [("hold", False), ("pose rest", True)])
    def test_a_start_that_failed_elsewhere_does_not_hold_unless_the_arm_has_moved(self, make_rig, startup, torque):
        rig = make_rig({"control": {"startup": startup}}).start()
        rig.core.begin_stop(unmoved=True)
        rig.tick(20)

        assert rig.core.stopped
        assert rig.hardware.torque == torque
