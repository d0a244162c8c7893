"""The control loop's work, tick by tick: modes, plans and goals."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from ibrobot_core.control import core
from ibrobot_core.control.commands import CancelGoals, SendGoal, SwitchMode
from ibrobot_core.control.position import PositionExecutor
from ibrobot_core.errors import ConfigError, HardwareError, NotSupported, PluginError
from ibrobot_core.interfaces.executor import FollowTrajectory, SlowDown
from ibrobot_core.interfaces.run_state import PlanRecord
from ibrobot_core.messages import Header, JointTrajectory, JointTrajectoryPoint

TRAJECTORY = JointTrajectory(Header(), ("pan", "lift"), (JointTrajectoryPoint(400_000_000, np.array([0.3, 0.2])),))
GOAL = SendGoal("arm_trajectory", "one", FollowTrajectory(TRAJECTORY))


class TestStart:
    def test_holds_where_it_is(self, make_rig):
        rig = make_rig({})
        measured = rig.hardware._position.copy()
        rig.start()

        np.testing.assert_array_equal(rig.tick(5).command, measured)

    def test_refuses_to_start_from_nowhere(self, make_rig):
        rig = make_rig({})
        rig.hardware._position[1] = np.nan

        with pytest.raises(HardwareError, match="joint lift is measured at nan"):
            rig.core.start("stream")

    def test_joints_that_never_answer_are_an_error(self, make_rig, monkeypatch):
        monkeypatch.setattr(core, "_FIRST_READING_S", 0.0)
        rig = make_rig({})
        rig.hardware.stale = True

        with pytest.raises(HardwareError, match="do not answer"):
            rig.core.start("stream")
        assert not rig.hardware.torque

    def test_refuses_to_promise_torque_off_on_hardware_without_it(self, make_rig):
        rig = make_rig({"hardware": {"type": "stiff"}, "control": {"stop": "relax"}})

        with pytest.raises(NotSupported, match=r"control.stop: relax: hardware 'hardware' cannot take torque off"):
            rig.core.start("stream")

    def test_needs_something_to_control(self, make_rig):
        with pytest.raises(ConfigError, match="hardware"):
            make_rig({"hardware": {}})


class TestModes:
    def test_switches_change_owners_within_a_tick_and_let_no_loaded_joint_sink(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.4, 0.5, 0.6])
        rig.tick(160)
        command = rig.core.state.command
        for mode in ("plan", "plan", "stream"):
            rig.hardware._position[1] -= 0.05  # its load pulls it down
            rig.tick()
            answer = rig.call(SwitchMode(mode=mode))
            assert answer["generation"] == rig.core.generation
            np.testing.assert_allclose(rig.tick(60).command, command, atol=1e-9)

    def test_switch_without_torque_begins_where_the_joints_are(self, make_rig, monkeypatch):
        relaxes = {"type": "position", "stale_timeout": 0.1, "safety_behavior": "relax"}
        executors = {
            "arm_position": {**relaxes, "group": "arm"},
            "gripper_position": {**relaxes, "group": "gripper"},
            "arm_trajectory": {"type": "waypoints", "group": "arm"},
            "gripper_action": {"type": "waypoints", "group": "gripper"},
        }
        rig = make_rig({"executors": executors}).start()
        rig.plan([0.4, 0.5, 0.6])
        rig.tick(160)
        assert rig.hardware.relaxed
        last = rig.hardware.read()
        position = last.position.copy()

        def read():
            return attrs.evolve(last, stamp_ns=rig.clock.now_ns(), position=position.copy())

        monkeypatch.setattr(rig.hardware, "read", read)
        for _ in range(20):
            position[1] -= 0.02  # it falls
            rig.tick()
        rig.call(SwitchMode(mode="plan"))

        assert rig.tick(20).command[1] == pytest.approx(position[1], abs=0.001)
        assert not rig.hardware.relaxed

    def test_a_switch_on_the_move_stays_within_the_limits(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.9, 1.0, 0.9], 0.4)
        rig.tick(20)
        rig.call(SwitchMode(mode="plan"))
        rig.tick(50)

        rig.assert_within_limits()
        np.testing.assert_array_equal(rig.tick().command, rig.core.state.command)

    def test_plans_from_before_a_switch_are_counted_and_not_followed(self, make_rig):
        rig = make_rig({}).start()
        before = rig.tick().command
        generation = rig.core.generation
        rig.call(SwitchMode(mode="plan"))
        rig.call(SwitchMode(mode="stream"))
        old = PlanRecord(generation, rig.clock.now_ns(), rig.core.period_ns, np.ones(3, bool), np.full((50, 3), 0.9))
        rig.core.set_plan(old)

        np.testing.assert_allclose(rig.tick(30).command, before, atol=1e-6)
        assert rig.core.counters()["loop"]["old_plans"] == 1

    def test_an_unknown_mode_is_refused_and_the_present_one_goes_on(self, make_rig):
        rig = make_rig({}).start()
        rig.plan([0.2, 0.2, 0.5])

        assert rig.call(SwitchMode(mode="dance"))["error"] == "no mode 'dance'; the modes are: stream, plan"
        np.testing.assert_allclose(rig.tick(70).command, [0.2, 0.2, 0.5], atol=1e-9)

    def test_a_plan_for_some_joints_moves_no_others(self, make_rig):
        rig = make_rig({}).start()
        before = rig.tick().command
        rig.plan([0.4, 0.4, 0.9], joints=(True, True, False))

        np.testing.assert_allclose(rig.tick(70).command, [0.4, 0.4, before[2]], atol=1e-9)


class TestLateTicks:
    def test_setpoints_are_those_of_the_time_at_which_the_tick_was_due(self, make_rig):
        """Otherwise a smooth plan would exceed the limits after every late tick."""
        rng, commands = np.random.default_rng(0), []
        for most_late in (0.0, 0.9):
            rig = make_rig({}).start()
            rig.tick(5)
            rig.plan([0.6, 0.5, 0.4])
            first_ns = rig.clock.now_ns()
            found = []
            for number in range(1, 40):
                due_ns = first_ns + number * rig.core.period_ns
                late_ns = round(most_late * rng.random() * rig.core.period_ns)
                rig.clock.sleep_until(due_ns + late_ns)
                state = rig.core.tick(due_ns, late_ns)
                assert (state.late_ns, state.stamp_ns) == (late_ns, due_ns + late_ns)
                found.append(state.command)
            commands.append(found)

        punctual, late = commands
        np.testing.assert_array_equal(late, punctual)


class TestWrongSetpoints:
    @pytest.mark.parametrize(
        "result",
        [
            None, 0.1, 1, True, "0.1", [0.1, 0.2, 0.3], (0.1, 0.2, 0.3), {}, np.float64(0.1), np.array(0.1),
            np.zeros(1), np.zeros(4), np.zeros((1, 3)), np.zeros((3, 1)), np.zeros(3, np.int64), np.array([None] * 3),
            np.array(["a"] * 3), np.zeros(3, complex),
        ],
        ids=repr,
    )  # fmt: skip
    def test_end_the_run_with_the_executor_and_its_class(self, make_rig, monkeypatch, result):
        rig = make_rig({}).start()
        monkeypatch.setattr(PositionExecutor, "update", lambda self, measured: result)
        written = len(rig.hardware.written)

        with pytest.raises(
            PluginError, match=r"\w+: update of <class 'ibrobot_core.control.position.PositionExecutor'> ret"
        ):
            rig.tick()
        assert len(rig.hardware.written) == written


class TestGoals:
    def test_reach_their_executor_and_report(self, make_rig):
        rig = make_rig({}).start("plan")
        assert "error" not in rig.call(GOAL)
        rig.tick(150)

        goals = rig.events("goal")
        assert [(goal["executor"], goal["goal"], goal["state"]) for goal in goals] == [
            ("arm_trajectory", "one", "executing"),
            ("arm_trajectory", "one", "succeeded"),
        ]
        np.testing.assert_allclose(rig.core.state.command[:2], [0.3, 0.2])

    def test_for_an_executor_that_is_not_active_are_refused(self, make_rig):
        rig = make_rig({}).start("stream")

        refused = "executor 'arm_trajectory' is not active; active: arm_position, gripper_position"
        assert rig.call(GOAL)["error"] == refused

    def test_that_are_malformed_are_refused(self, make_rig):
        rig = make_rig({}).start("plan")
        assert "error" in rig.call(attrs.evolve(GOAL, goal=SlowDown()))
        assert rig.events("goal") == []

    def test_to_slow_down_come_with_where_the_commands_come_to_rest(self, make_rig, monkeypatch):
        rig = make_rig({}).start("plan")
        rig.call(GOAL)
        rig.tick(10)
        readings = []
        executor = rig.core._executors._all["arm_trajectory"].executor
        monkeypatch.setattr(executor, "set_goal", lambda *goal: readings.append(goal[-1]))
        rig.call(attrs.evolve(GOAL, goal=SlowDown()))

        rest = rig.core._safety.rest[:2]
        np.testing.assert_array_equal(readings[0].position, rest)
        assert (rest > rig.core.state.command[:2]).all()

    def test_end_with_the_mode_or_a_cancel(self, make_rig):
        rig = make_rig({}).start("plan")
        for end in (CancelGoals(), SwitchMode("stream")):
            rig.call(SwitchMode(mode="plan"))
            rig.events("goal")
            rig.call(GOAL)
            rig.tick(10)
            rig.call(end)
            rig.tick()

            assert [goal["state"] for goal in rig.events("goal")] == ["executing", "canceled"]
