"""The control loop's work, tick by tick: what happens when something fails, and how it stops."""

from __future__ import annotations

import numpy as np
import pytest

from ibrobot_core.control.commands import ClearFaults, EmergencyStop, ResetEpisode, SwitchMode
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces import Torque


class TestFailures:
    def test_a_lost_reply_is_ridden_out_without_a_jerk(self, make_rig):
        rig, undisturbed = make_rig({}).start(), make_rig({}).start()
        for each in (rig, undisturbed):
            each.plan([0.4, 0.4, 0.9])
        for tick in range(40):
            rig.hardware.stale = tick % 10 == 5
            assert rig.tick().stale == (tick % 10 == 5)
            np.testing.assert_array_equal(rig.core.state.command, undisturbed.tick().command)

        assert rig.core.fault == ""
        assert rig.core.counters()["loop"]["stale_states"] == 4

    def test_an_error_of_the_hardware_is_a_fault_at_once(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 0.5)
        rig.tick(20)
        rig.hardware.silent = True
        assert rig.tick().stale
        assert rig.core.fault
        rig.tick(20)
        rig.assert_within_limits()
        assert rig.core.counters()["loop"]["read_errors"] == 21
        assert len(rig.events("fault")) == 1

    def test_stale_states_for_the_state_timeout_are_a_fault_and_brake(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 0.5)
        rig.tick(20)
        rig.hardware.stale = True

        assert rig.tick(4).stale
        assert rig.core.fault == ""
        rig.tick()
        assert "no state for 50 ms" in rig.core.fault
        rig.tick(8)
        resting = rig.core.state.command
        np.testing.assert_array_equal(rig.tick(20).command, resting)
        rig.assert_within_limits()
        assert len(rig.events("fault")) == 1

    def test_a_fault_lasts_until_reset(self, make_rig):
        rig = make_rig({}).start()
        rig.hardware.write_error = "the port is gone"
        rig.tick()
        assert rig.core.fault == "the port is gone"
        rig.hardware.write_error = ""
        rig.tick()

        assert "before a reset: the port is gone" in rig.call(SwitchMode(mode="plan"))["error"]
        rig.plan([0.3, 0.3, 0.3])
        assert rig.core.counters()["loop"]["old_plans"] == 1
        assert "error" not in rig.call(ClearFaults())
        rig.plan([0.3, 0.3, 0.3])
        np.testing.assert_allclose(rig.tick(70).command, 0.3)

    def test_a_reset_before_the_joints_answer_is_refused_and_the_fault_stays(self, make_rig):
        rig = make_rig({}).start()
        rig.hardware.silent = True
        rig.tick(20)
        rig.hardware.reset_faults = lambda: None

        assert rig.call(ClearFaults())["error"] == "the bus is silent"
        assert rig.core.fault
        rig.hardware.silent = False
        assert "error" not in rig.call(ClearFaults())
        assert not rig.core.fault

    def test_signals_that_fail_are_missing_and_stop_nothing(self, make_rig):
        rig = make_rig({}).start()
        assert np.isfinite(rig.tick().signals).all()
        rig.hardware.signal_error = "no temperature"

        assert np.isnan(rig.tick().signals).all()
        assert rig.core.fault == ""
        assert rig.core.counters()["loop"]["signal_errors"] == 1

    def test_of_two_parts_the_failing_one_is_named(self, make_rig):
        hardware = {
            "hand": {"type": "scripted", "joints": ["grip", "lift"]},
            "base": {"type": "scripted", "joints": ["pan"]},
        }
        rig = make_rig({"hardware": hardware}).start()
        rig.plan([0.3, -0.2, 0.9])
        rig.tick(80)
        np.testing.assert_allclose(rig.parts["hand"].written[-1], [0.9, -0.2])
        np.testing.assert_allclose(rig.parts["base"].written[-1], [0.3])

        rig.parts["hand"].write_error = "servo 2 does not answer"
        rig.tick()
        rig.core.close()
        assert rig.core.fault == "hand: servo 2 does not answer"


class TestEmergencyStop:
    def test_brakes_and_is_latched_until_reset(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 0.5)
        rig.tick(20)
        rig.call(EmergencyStop())
        state = rig.tick(8)
        assert state.estop
        rig.plan([0.0, 0.0, 0.0])
        np.testing.assert_array_equal(rig.tick(30).command, state.command)
        rig.assert_within_limits()
        assert [event["fault"] for event in rig.events("fault")] == ["emergency stop"]

        assert "error" not in rig.call(ClearFaults())
        assert not rig.tick().estop
        rig.plan([0.0, 0.0, 0.0])
        np.testing.assert_allclose(rig.tick(80).command, 0.0)

    def test_cannot_be_reset_while_the_robot_brakes(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 0.5)
        rig.tick(20)
        rig.call(EmergencyStop())
        rig.tick()

        assert "still braking" in rig.call(ClearFaults())["error"]
        assert rig.tick().estop

    def test_a_reset_on_the_move_makes_no_step(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 0.5)
        rig.tick(20)
        assert "error" not in rig.call(ClearFaults())
        rig.tick(50)

        rig.assert_within_limits()


class TestStop:
    def test_hold_brakes_within_100_ms(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.4, 0.9], 0.45)
        rig.tick(20)
        assert rig.stop() <= 10
        rig.assert_within_limits()

    def test_pose_is_reached_without_interventions(self, make_rig):
        rig = make_rig({"control": {"stop": "pose rest"}}).start()
        ticks = rig.stop()

        np.testing.assert_allclose(rig.core.state.command, [-0.8, 1.0, 0.1], atol=1e-4)
        assert ticks > 30
        assert rig.interventions == 0
        rig.assert_within_limits()

    def test_a_pose_that_takes_too_long_is_given_up_at_rest(self, make_rig):
        joint = {"name": "pan", "lower": -1.0, "upper": 3.0, "max_velocity": 0.2, "max_acceleration": 2.0}
        edits = {
            "robot": {
                "name": "slow",
                "joints": [joint],
                "groups": {"arm": ["pan"]},
                "description": {"poses": {"far": [3.0]}},
            },
            "control": {"stop": "pose far"},
            "executors": {"one": {"type": "position", "group": "arm"}},
            "control_modes": {"stream": {"executors": ["one"]}},
        }
        rig = make_rig(edits).start()

        assert 1000 <= rig.stop(1100) < 1030
        assert 0.3 < rig.core.state.command[0] < 2.9

    def test_a_fault_on_the_way_to_the_pose_ends_it(self, make_rig):
        rig = make_rig({"control": {"stop": "pose rest"}}).start()
        rig.core.begin_stop()
        rig.tick(30)
        assert not rig.core.stopped
        rig.hardware.write_error = "the port is gone"
        rig.tick(10)

        assert rig.core.stopped

    def test_relax_takes_torque_off_at_once(self, make_rig, caplog):
        rig = make_rig({"control": {"stop": "relax"}}).start()
        assert rig.stop() == 0
        assert rig.hardware.relaxed
        assert "torque off (stop): the arm may fall" in caplog.text

    def test_relax_is_what_a_fault_does_too(self, make_rig):
        rig = make_rig({"control": {"stop": "relax"}}).start()
        rig.call(EmergencyStop())
        count = len(rig.hardware.written)
        rig.tick(20)

        assert rig.hardware.relaxed
        assert len(rig.hardware.written) == count

    @pytest.mark.parametrize(
        ("outcome", "message"),
        [
            (Torque.UNKNOWN, "torque of hardware may still be on: nothing confirmed that it is off"),
            (HardwareError("servo 3 keeps it"), "torque of hardware cannot be taken off: servo 3 keeps it"),
        ],
        ids=["unknown", "failed"],
    )
    def test_relax_that_is_not_confirmed_is_reported_beside_the_fault(self, make_rig, caplog, outcome, message):
        rig = make_rig({"control": {"stop": "relax"}}).start()
        rig.hardware.relax_outcome = outcome
        rig.hardware.silent = True
        rig.tick(3)

        assert rig.core.fault == "the bus is silent"
        assert [event["fault"] for event in rig.events("fault")] == ["the bus is silent", message]
        assert "torque off" not in caplog.text

    def test_a_failed_relax_goes_on_braking_and_an_unconfirmed_one_writes_no_more(self, make_rig):
        for outcome, writes in ((HardwareError("servo 3 keeps it"), True), (Torque.UNKNOWN, False)):
            rig = make_rig({"control": {"stop": "relax"}}).start()
            rig.plan([0.9, 1.0, 0.9], 0.5)
            rig.tick(20)
            rig.hardware.relax_outcome = outcome
            rig.call(EmergencyStop())
            count = len(rig.hardware.written)
            rig.tick(20)

            assert (len(rig.hardware.written) > count) == writes
            rig.assert_within_limits()

    def test_of_two_parts_the_relaxed_one_is_not_written_while_the_other_brakes(self, make_rig):
        hardware = {
            "hand": {"type": "scripted", "joints": ["grip", "lift"]},
            "base": {"type": "scripted", "joints": ["pan"]},
        }
        rig = make_rig({"hardware": hardware, "control": {"stop": "relax"}}).start()
        rig.plan([0.3, -0.2, 0.9])
        rig.tick(20)
        hand, base = rig.parts["hand"], rig.parts["base"]
        base.relax_outcome = HardwareError("servo 1 keeps it")
        rig.call(EmergencyStop())
        counts = len(hand.written), len(base.written)
        rig.tick(20)
        assert hand.relaxed
        assert len(hand.written) == counts[0]
        assert len(base.written) == counts[1] + 20
        assert rig.core.counters()["loop"]["write_errors"] == 0

        assert "error" not in rig.call(ClearFaults())
        rig.tick()
        rig.core.close()
        assert not hand.relaxed

    @pytest.mark.parametrize("stop", ["hold", "pose rest"])
    def test_nothing_moves_the_robot_any_more(self, make_rig, stop):
        rig = make_rig({"control": {"stop": stop}}).start()
        rig.core.begin_stop()

        assert rig.call(ClearFaults())["error"] == "refused while the robot is stopping"
        rig.plan([0.9, 0.9, 0.9])
        assert rig.core.counters()["executors"]["arm_position"]["stale"] == 0


class TestStaleSetpoints:
    def test_relax_when_configured_and_begin_again_from_where_the_arm_lies(self, make_rig):
        relaxing = {
            "arm_position": {"type": "position", "group": "arm", "safety_behavior": "relax"},
            "gripper_position": {"type": "position", "group": "gripper", "safety_behavior": "relax"},
        }
        rig = make_rig({"executors": relaxing, "control_modes": {"stream": {"executors": list(relaxing)}}}).start()
        rig.plan([0.5, 0.5, 0.5], 0.3)
        rig.tick(70)
        assert rig.hardware.relaxed
        count = len(rig.hardware.written)
        for _ in range(10):  # it falls
            rig.hardware._position += np.clip([-0.3, -0.4, 0.2] - rig.hardware._position, -0.15, 0.15)
            rig.tick()
        assert len(rig.hardware.written) == count

        rig.plan([0.5, 0.5, 0.5], 0.3)
        rig.tick()
        assert not rig.hardware.relaxed
        np.testing.assert_allclose(rig.hardware.written[count], [-0.3, -0.4, 0.2], atol=0.01)


class TestSimulation:
    def test_an_episode_begins_from_its_seed(self, make_rig):
        rig = make_rig({}, sim=True).start()
        rig.plan([0.9, 1.0, 0.9], 0.5)
        rig.tick(20)
        starts = []
        for seed in (3, 4, 3):
            generation = rig.core.generation
            assert rig.call(ResetEpisode(seed=seed))["generation"] > generation
            starts.append(rig.tick().command)

        np.testing.assert_array_equal(starts[0], starts[2])
        assert (starts[0] != starts[1]).all()

    def test_missed_ticks_do_not_slow_it_down(self, make_rig):
        one, other = make_rig({}, sim=True).start(), make_rig({}, sim=True).start()
        for rig in (one, other):
            rig.hardware._command = np.array([0.5, 0.5, 0.5])
            rig.hardware.write_error = ""
            rig.hardware.write = lambda position: None
        one.tick(4)
        other.core.tick(periods=4)

        np.testing.assert_allclose(one.hardware._position, other.hardware._position)
