"""Joints that do not follow: what counts as away, for how long, and what the control loop does about it."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from ibrobot_testing.contexts import make_robot

from ibrobot_core.config.schema import Following
from ibrobot_core.control.following import FollowingError

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

        assert "error" not in rig.call("reset")
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
        rig.call("estop")
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
