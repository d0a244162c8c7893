"""Nothing moves that nobody asked for: a teleoperated arm waits for its deadman whenever it may begin to move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from ibrobot_core.errors import TeleopError

if TYPE_CHECKING:
    from conftest import Runs
    from ibrobot_core.launch.runtime import Runtime


@pytest.fixture
def run(runs: Runs) -> Runtime:
    runtime = runs.start("control_modes.teleop.teleop=lever", mode="teleop")
    runs.parts.MADE["lever"].velocity = 0.5
    return runtime


def moves(run: Runtime, ticks: int = 30) -> bool:
    """Whether the robot moves in so many ticks."""
    assert run.session.state is not None
    before = run.session.state.command
    for _ in range(ticks):
        run.step()
    return bool(np.abs(run.session.state.command - before).max() > 1e-6)


def reset_after_a_stop(run: Runtime, runs: Runs) -> None:
    run.session.control.call("estop")
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
    runs.parts.MADE["lever"].deadman = True
    assert moves(run)


@pytest.mark.parametrize(
    "begin", [reset_after_a_stop, reset_alone, come_back_to_the_mode, connect_the_device_again],
    ids=lambda f: f.__name__,
)  # fmt: skip
def test_a_deadman_pressed_before_does_not_count_after(run: Runtime, runs: Runs, begin) -> None:
    runs.parts.MADE["lever"].deadman = True
    assert moves(run)
    begin(run, runs)

    moves(run, 15)  # a reset on the move brakes within the limits
    assert not moves(run)
    runs.parts.MADE["lever"].deadman = True
    assert moves(run)
