"""Hardware of type ros2_control, against a controller written with rclpy."""

from __future__ import annotations

import re

import pytest

from ibrobot_core.api import IbrobotError

from .conftest import DOMAIN, PYTHON, ROBOT, Peer, until

JOINTS = ["pan", "lift", "roll", "grip"]
HARDWARE = f"{{type: ros2_control, controller: arm_controller, python: {PYTHON}, domain: {DOMAIN}}}"
REMOTE = ROBOT.replace("simulation: {type: arm}", f"hardware: {HARDWARE}").replace(
    "control: {rate_hz: 100,", "control: {rate_hz: 100, state_timeout: 0.5,"
)


@pytest.fixture
def controller(peers) -> Peer:
    peers.append(Peer("controller.py", *JOINTS))
    return peers[-1]


@pytest.fixture
def begin(start, controller):
    def begin(*overrides, **asked):
        return start("ros.actions=true", *overrides, robot=REMOTE, sim=False, **asked)

    return begin


def position(run):
    return run.session.measured().position


def test_a_trajectory_moves_the_other_robot(begin, controller, peers):
    run = begin()
    peers.append(Peer())
    outcome = peers[-1].ask(
        "follow",
        action="/arm_trajectory/follow_joint_trajectory",
        joints=JOINTS[:3],
        points=[[1.0, [0.3, -0.2, 0.1], [0.0] * 3]],
    )
    assert outcome["status"] == "SUCCEEDED"
    state = controller.ask("state")
    assert state["position"][:3] == pytest.approx([0.3, -0.2, 0.1], abs=0.03)
    run.check_steps()


def test_planning_teleoperation_and_a_policy(begin, controller):
    run = begin(mode="plan")
    run.session.bus.call("/planning/go_to", "pan=0.4,lift=0.1,roll=0")
    until(lambda: abs(position(run)[0] - 0.4) < 0.03)
    run.runtime.switch_mode("teleop")
    before = position(run)[0]
    until(lambda: position(run)[0] < before - 0.1)
    run.runtime.switch_mode("policy")
    before = position(run).copy()
    until(lambda: abs(position(run) - before).max() > 0.1)
    assert not run.session.faults
    run.check_steps()


def test_a_recording_through_it(begin, tmp_path):
    run = begin("recording={type: mcap, topics: all}", mode="teleop", by_operator=True)
    run.session.bus.call("/record_episode/start")
    before = len(run.commands)
    until(lambda: len(run.commands) > before + 100)
    run.session.bus.call("/record_episode/stop", "success")
    run.runtime.stop()
    assert (tmp_path / "episodes/default/episodes/episode_000001/metadata.yaml").exists()


def reset(run):
    """Whether a reset succeeds: not while the robot still brakes."""
    try:
        run.session.bus.call("/reset")
    except IbrobotError:
        return False
    return True


@pytest.mark.parametrize(
    ("trouble", "fault"),
    [("killed", "no state for|nobody subscribes"), ("silent", "no state for"), ("nan", "is not a number")],
)
def test_a_controller_in_trouble_in_motion(begin, controller, trouble, fault):
    run = begin(mode="plan")
    run.session.bus.call("/planning/go_to", "pan=1.5,lift=1.0,roll=0")
    until(lambda: position(run)[0] > 0.1)
    if trouble == "killed":
        controller.process.kill()
    else:
        controller.ask("set", trouble=trouble)
    until(lambda: run.session.faults)
    assert re.search(fault, run.session.faults[-1])
    assert run.session.failure_text == "", "the run goes on, and can be reset"
    if trouble != "killed":
        controller.ask("set", trouble="")
        until(lambda: not run.session.state.stale)
        until(lambda: reset(run))
        assert not run.session.faults


def test_stamps_of_another_clock_are_refused(begin, controller):
    controller.ask("set", trouble="other clock")
    with pytest.raises(IbrobotError, match="set stamp: receive"):
        begin()


def test_no_controller_is_named(start):
    with pytest.raises(IbrobotError, match="no node publishes /joint_states with pan, lift, roll, grip"):
        start(robot=REMOTE, sim=False)
