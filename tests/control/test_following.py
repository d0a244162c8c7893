"""Joints that do not follow: what counts as away, for how long, and what the control loop does about it."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_testing.contexts import make_robot

from ibrobot_core.control.commands import ClearFaults, EmergencyStop
from ibrobot_core.control.following import FollowingError
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.schema import Following

ROBOT = make_robot()
PERIOD_NS = 10_000_000
STILL = np.zeros(6)
OPTIONS = Following(distance=0.2, timeout=0.5)
TIMEOUT_TICKS = 50


def watch(away: float, joint: int = 1, ticks: int = 200, speed: float = 0.0) -> str:
    """What is found wrong with a joint that stays so far away."""
    following = FollowingError(OPTIONS, ROBOT, PERIOD_NS)
    setpoint, velocity = STILL.copy(), STILL.copy()
    setpoint[joint], velocity[joint] = away, speed
    for _ in range(ticks):
        fault = following.check(setpoint, velocity, STILL)
    return fault


@pytest.mark.parametrize("away", [0.21, -0.21])
def test_a_joint_that_stays_away_is_named_with_its_distance_and_a_remedy(away: float) -> None:
    fault = watch(away)

    assert "joint shoulder_lift does not follow" in fault
    assert "0.21 rad" in fault
    assert "0.5 s" in fault
    assert "check what is in its way" in fault


def test_it_may_be_away_for_a_time() -> None:
    assert watch(0.5, ticks=TIMEOUT_TICKS - 1) == ""
    assert watch(0.5, ticks=TIMEOUT_TICKS) != ""


def test_it_may_hang_from_its_setpoint_and_lag_behind_it() -> None:
    assert watch(0.19) == ""
    assert watch(0.4, speed=2.1) == ""
    assert watch(0.4, speed=-1.9) != ""


def test_a_return_begins_the_time_again() -> None:
    following = FollowingError(OPTIONS, ROBOT, PERIOD_NS)
    for _ in range(5):
        faults = [following.check(np.full(6, 0.4), STILL, STILL) for _ in range(TIMEOUT_TICKS - 1)]
        assert set(faults) == {""}
        following.check(STILL, STILL, STILL)


def test_with_a_short_lead_half_of_it_is_away() -> None:
    joints = tuple(attrs.evolve(joint, max_lead=0.1) for joint in ROBOT.joints)
    following = FollowingError(OPTIONS, attrs.evolve(ROBOT, joints=joints), PERIOD_NS)
    for _ in range(TIMEOUT_TICKS):
        fault = following.check(np.full(6, 0.06), STILL, STILL)

    assert fault


def test_a_gripper_may_squeeze_for_ever() -> None:
    gripper = ROBOT.joint_names.index("gripper")

    assert watch(1.0, joint=gripper) == ""


@pytest.mark.parametrize(("grips", "faults"), [(True, False), (False, True)])
def test_the_yaml_says_which_joints_grip(grips: bool, faults: bool) -> None:
    joints = tuple(attrs.evolve(joint, grips=grips) for joint in ROBOT.joints)
    following = FollowingError(OPTIONS, attrs.evolve(ROBOT, joints=joints), PERIOD_NS)
    for _ in range(TIMEOUT_TICKS):
        fault = following.check(np.full(6, 1.0), STILL, STILL)

    assert bool(fault) == faults


class TestControl:
    """In the control loop, on a joint that something blocks."""

    @pytest.fixture
    def rig(self, make_rig):
        rig = make_rig({}).start()
        rig.hardware.blocked[0] = True
        return rig

    def test_a_blocked_joint_is_a_fault_and_presses_no_longer(self, rig):
        start = rig.hardware._position[0]
        rig.plan([start - 0.9, 0.3, 0.5], 1.0)
        reserve = 3.0**2 / (2 * 40.0) / 4
        lead = rig.config.robot.max_lead[0] - reserve
        leads = []
        for _ in range(400):
            state = rig.tick()
            leads.append(state.position[0] - state.command[0])
            if rig.core.fault:
                break

        assert max(leads) == pytest.approx(lead)
        assert "joint pan does not follow: it is 0." in rig.core.fault
        assert rig.core.counters()["safety"]["lead"] > 0
        assert rig.core.counters()["loop"]["following_errors"] == 1
        rig.tick(100)
        assert rig.core.state.command[0] == pytest.approx(start)
        np.testing.assert_allclose(rig.core.state.command[1:], [0.3, 0.5])
        rig.assert_within_limits()

    def test_what_is_released_before_does_not_jump(self, rig):
        start = rig.hardware._position[0]
        rig.plan([start - 0.9, 0.3, 0.5], 1.0)
        rig.tick(120)
        rig.hardware.blocked[0] = False
        rig.tick(100)

        assert rig.core.fault == ""
        rig.assert_within_limits()

    def test_a_reset_begins_the_time_again_from_where_the_joint_is(self, rig):
        rig.plan([-0.9, 0.3, 0.5], 1.0)
        rig.tick(400)
        assert rig.core.fault
        rig.hardware.blocked[0] = False

        assert "error" not in rig.call(ClearFaults())
        rig.tick(300)
        assert rig.core.fault == ""

    def test_a_grasp_lasts(self, rig):
        rig.hardware.blocked[:] = [False, False, True]
        rig.plan([0.0, 0.0, 1.0], 0.5)
        for _ in range(10):
            rig.tick(50)
            rig.plan([0.0, 0.0, 1.0], 0.5)

        assert rig.core.fault == ""
        squeeze = rig.core.state.command[2] - rig.hardware._position[2]
        assert 0.25 < squeeze <= rig.config.robot.max_lead[2]

    @pytest.mark.parametrize("joint", [0, 1])
    def test_on_the_way_to_a_pose_it_ends_the_way(self, make_rig, joint):
        rig = make_rig({"control": {"stop": "pose rest"}}).start()
        rig.hardware.blocked[joint] = True

        rig.stop()
        assert "does not follow" in rig.core.fault
        rig.assert_within_limits()

    def test_an_arm_without_torque_is_not_watched(self, make_rig):
        rig = make_rig({"control": {"stop": "relax"}}).start()
        rig.call(EmergencyStop())
        rig.hardware._position[0] -= 0.9
        rig.tick(400)

        assert [event["fault"] for event in rig.events("fault")] == ["emergency stop"]

    def test_lost_replies_are_no_following_error(self, make_rig):
        rig = make_rig({"control": {"state_timeout": 60.0}}).start()
        rig.plan([0.9, 1.0, 0.9], 0.4)
        rig.tick(5)
        rig.hardware.stale = True
        rig.tick(400)

        assert rig.core.fault == ""


class Servos:
    """Joints whose motors get each other's commands, with a servo's lag, below the safety layer.

    Args:
        start: where they are [rad], shape (6,).
        order: `order[j]` is the joint whose command motor j gets.
        lag_s: time constant of the motors [s].
    """

    def __init__(self, start: np.ndarray, order: np.ndarray, lag_s: float = 0.08) -> None:
        fast = tuple(attrs.evolve(joint, max_velocity=3.0, max_acceleration=40.0) for joint in ROBOT.joints)
        robot = attrs.evolve(ROBOT, joints=fast)
        self.start, self.measured, self.order = start, start.copy(), order
        self.share = 1 - np.exp(-PERIOD_NS / 1e9 / lag_s)
        self.safety = SafetyLayer(robot, PERIOD_NS)
        self.safety.activate(start)
        self.following = FollowingError(Following(), robot, PERIOD_NS)

    def tick(self, target: np.ndarray, push: np.ndarray = STILL) -> str:
        command = self.safety.apply(target, self.measured)
        self.measured = self.measured + (command[self.order] - self.measured) * self.share + push
        return self.following.check(command, self.safety.velocity, self.measured)

    def run(self, target: np.ndarray, ticks: int = 150) -> str:
        return next((fault for _ in range(ticks) if (fault := self.tick(target))), "")


def within(share: float) -> st.SearchStrategy[np.ndarray]:
    """Positions in this share of the joints' limits, shape (6,)."""
    return st.tuples(*[st.floats(-share, share)] * 6).map(
        lambda at: np.where(np.array(at) > 0, ROBOT.upper, -ROBOT.lower) * np.array(at)
    )


class TestExchangedMotors:
    @settings(max_examples=20, deadline=None)
    @given(start=within(0.6), target=within(1.0), order=st.permutations(range(6)), lag_s=st.floats(0.02, 0.12))
    def test_joints_that_move_as_others_are_commanded_are_a_fault(self, start, target, order, lag_s):
        servos = Servos(start, np.array(order), lag_s)
        fault = servos.run(target)

        astray = np.abs(servos.measured - servos.safety.current).max() > 0.15
        assert not astray or "their motors are exchanged" in fault

    @pytest.mark.parametrize("late", [16, 20, 24])
    @pytest.mark.parametrize("way", [0.8, 1.0, 1.2])
    def test_joints_that_are_late_alike_are_none(self, late, way):
        """Three move behind one another, so that each is where the next one is commanded."""
        start = np.array([0.0, -0.6, -1.2, 0.0, 0.0, 0.0])
        servos = Servos(start, np.arange(6))
        target = start + np.array([way, way, way, 0.0, 0.0, 0.0])
        commands = [start.copy()] * (late + 1)
        for _ in range(150):
            commands.append(servos.safety.apply(target, servos.measured).copy())
            servos.measured = commands[-1 - late]
            assert servos.following.check(commands[-1], servos.safety.velocity, servos.measured) == ""

    def test_both_joints_are_named(self):
        order = np.array([0, 3, 2, 1, 4, 5])
        target = STILL.copy()
        target[1] = 0.6
        fault = Servos(STILL.copy(), order).run(target)

        names = ROBOT.joint_names
        assert fault.startswith(f"joint {names[3]} moves as {names[1]} is commanded")
        assert "check their ids and cables" in fault

    @settings(max_examples=20, deadline=None)
    @given(start=within(0.6), targets=st.lists(within(1.0), min_size=1, max_size=4), lag_s=st.floats(0.02, 0.15))
    def test_joints_that_follow_their_own_commands_are_none(self, start, targets, lag_s):
        servos = Servos(start, np.arange(6), lag_s)

        assert {servos.run(target, 80) for target in targets} == {""}

    @pytest.mark.parametrize("joint", range(6))
    def test_a_joint_that_a_hand_pushes_is_none(self, joint):
        servos, push = Servos(STILL.copy(), np.arange(6)), STILL.copy()
        push[joint] = 0.05
        faults = {servos.tick(STILL, push) for _ in range(60)} | {servos.tick(STILL) for _ in range(60)}

        assert faults == {""}
