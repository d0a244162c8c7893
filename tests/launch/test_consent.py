"""Nothing moves that nobody asked for: teleoperation waits for its deadman, a policy after a fault for its mode key."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from ibrobot_core.errors import HardwareError, TeleopError
from ibrobot_core.launch.runtime import RESET, SET_MODE
from ibrobot_core.messages import RobotStatus

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.launch.runtime import Runtime


@pytest.fixture
def run(runs: Runs) -> Runtime:
    runtime = runs.start("control_modes.teleop.teleop=lever", mode="teleop")
    runs.parts.MADE["lever"].velocity = 0.5
    return runtime


def moves(run: Runtime, ticks: int = 30) -> bool:
    """Whether the robot moves in so many ticks."""
    run.step()  # a reset puts the setpoint where the joints are
    assert run.session.state is not None
    before = run.session.state.command
    for _ in range(ticks):
        run.step()
    return bool(np.abs(run.session.state.command - before).max() > 1e-6)


def reset_after_a_stop(run: Runtime, runs: Runs) -> None:
    run.session.emergency_stop()
    moves(run, 15)  # it brakes
    assert not moves(run)
    run.reset()


def reset_alone(run: Runtime, runs: Runs) -> None:
    run.reset()


def come_back_to_the_mode(run: Runtime, runs: Runs) -> None:
    run.switch_mode("idle")
    run.switch_mode("teleop")
    runs.parts.MADE["lever"].velocity = 0.5


def connect_the_device_again(run: Runtime, runs: Runs) -> None:
    device = runs.parts.MADE["lever"]
    read = device.read

    def gone(measured: object) -> None:
        raise TeleopError("the lever is gone")

    device.read = gone
    moves(run, 10)
    assert run.session.outcome.faults == ["the lever is gone"]
    device.read = read
    run.reset()


def test_a_launch_moves_nothing(run: Runtime, runs: Runs) -> None:
    assert not moves(run)
    runs.parts.MADE["lever"].press()
    assert moves(run)


@pytest.mark.parametrize(
    "begin",
    [reset_after_a_stop, reset_alone, come_back_to_the_mode, connect_the_device_again],
    ids=lambda f: f.__name__,
)
def test_a_deadman_pressed_before_does_not_count_after(run: Runtime, runs: Runs, begin) -> None:
    runs.parts.MADE["lever"].press()
    assert moves(run)
    begin(run, runs)

    moves(run, 15)  # a reset on the move brakes within the limits
    assert not moves(run)
    runs.parts.MADE["lever"].press()
    assert moves(run)


def press_the_emergency_stop(run: Runtime, runs: Runs) -> None:
    run.session.emergency_stop()


def silence_the_hardware(run: Runtime, runs: Runs) -> None:
    runs.parts.MADE["simulation"].broken = True


@pytest.fixture
def policy(runs: Runs) -> Runtime:
    """A policy that never succeeds, on a robot with an operator."""
    runtime = runs.start("contract.max_duration_s=100", by_operator=True)
    runs.parts.Scene.success = lambda scene: False
    assert moves(runtime)
    return runtime


@pytest.mark.parametrize("stop", [press_the_emergency_stop, silence_the_hardware], ids=lambda f: f.__name__)
def test_after_a_fault_and_its_reset_a_policy_waits_until_its_mode_is_entered(policy: Runtime, runs: Runs, stop):
    stop(policy, runs)
    moves(policy, 15)  # it brakes
    holding = "reset; holding: press F1 to go on with policy"
    assert policy.session.bus.call(RESET, None) == holding
    assert policy.session.bus.call(RESET, None) == holding, "a second reset starts nothing either"
    assert not moves(policy, 100)
    policy.session.bus.call(SET_MODE, "policy")
    assert moves(policy)


def test_a_held_policy_goes_on_in_no_other_way(policy: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    press_the_emergency_stop(policy, runs)
    moves(policy, 15)
    policy.reset()
    press_the_emergency_stop(policy, runs)
    with pytest.raises(HardwareError, match="refused before a reset: emergency stop"):
        policy.switch_mode("policy")
    policy.reset()
    with monkeypatch.context() as patched:
        patched.setattr(policy.session.control, "call", lambda do, **_: (_ for _ in ()).throw(HardwareError("not now")))
        with pytest.raises(HardwareError, match="not now"):
            policy.switch_mode("teleop")
    assert not moves(policy)
    policy.switch_mode("idle")
    assert not moves(policy)
    policy.switch_mode("policy")
    assert moves(policy)


def test_a_reset_that_cleared_nothing_changes_nothing_for_a_policy(policy: Runtime) -> None:
    assert policy.reset() == "reset; mode policy starts over"
    assert moves(policy)


def test_a_held_episode_in_simulation_ends_and_the_next_one_waits_too(runs: Runs) -> None:
    runtime = runs.start("contract.max_duration_s=1", episodes=2, seed=13)
    moves(runtime, 10)
    press_the_emergency_stop(runtime, runs)
    moves(runtime, 15)
    runtime.reset()
    assert not moves(runtime, 100)
    assert [event[0] for event in runs.parts.EVENTS] == ["started", "fault", "ended"]
    runtime.switch_mode("policy")
    assert moves(runtime)
    moves(runtime, 100)
    assert runtime.session.finished.is_set()
    assert runtime.summary()["successes"] == 2  # the episode that the stop ended does not count


def test_status_has_a_fault_until_its_reset_and_the_summary_to_the_end(run: Runtime, runs: Runs) -> None:
    status = run.session.bus.subscribe("/robot_status", 1)

    def faults() -> tuple[str, ...]:
        moves(run)
        received = status.get()
        assert received is not None
        assert isinstance(received.message, RobotStatus)
        return received.message.faults

    device = runs.parts.MADE["lever"]
    read = device.read

    def gone(measured: object) -> None:
        raise TeleopError("the lever is gone")

    device.read = gone
    assert faults() == ("the lever is gone",)
    device.read = read
    run.reset()
    assert faults() == ()
    assert run.summary()["faults"] == ["the lever is gone"]
    status.close()
