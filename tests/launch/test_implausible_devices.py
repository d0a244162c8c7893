"""Commands of teleoperation devices to which no hand can have moved them, of whichever plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ibrobot_core.interfaces import TeleopCommand

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.launch.runtime import Runtime

PERIOD_S = 0.02
PATIENCE_TICKS = 5
"""`control.state_timeout` in ticks."""


@pytest.fixture
def device(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Positions that the device of mode `teleop` commands [rad]."""
    pose = {"pan": 0.0, "grip": 0.0}
    runs.make(mode="teleop")  # imports the fakes
    monkeypatch.setattr(runs.parts.Stick, "read", lambda self, measured: TeleopCommand(dict(pose)))
    return pose


def step(run: Runtime, count: int = 1) -> None:
    for _ in range(count):
        run.step()


def commanded(run: Runtime) -> np.ndarray:
    assert run.session.state is not None
    return run.session.state.command


@pytest.mark.parametrize("jump", [1.05, -0.9, np.nan, np.inf, -np.inf, 1e308])
def test_a_jump_that_lasts_is_a_fault_and_moves_nothing(runs: Runs, device: dict[str, float], jump: float):
    run = runs.start(mode="teleop")
    step(run, 10)
    device["pan"] = jump
    step(run, PATIENCE_TICKS + 3)

    (fault,) = run.session.faults
    assert fault.startswith("stick: joint pan is measured")
    step(run, 50)
    np.testing.assert_allclose(commanded(run), 0.0, atol=0.01)


def test_a_jump_of_a_moment_is_passed_over(runs: Runs, device: dict[str, float]):
    run = runs.start(mode="teleop")
    step(run, 10)
    for tick in range(50):
        device["pan"] = 0.002 * tick + (1.0 if tick in (20, 21) else 0.0)
        step(run)
        assert commanded(run)[0] <= 0.002 * tick + 1e-6
    step(run, 3)

    assert run.session.faults == ()
    np.testing.assert_allclose(commanded(run)[0], 0.098, atol=1e-3)


def test_a_trigger_may_snap(runs: Runs, device: dict[str, float]):
    run = runs.start(mode="teleop")
    step(run, 10)
    device["grip"] = 0.9
    step(run, 60)

    assert run.session.faults == ()
    np.testing.assert_allclose(commanded(run)[1], 0.9, atol=1e-3)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(-8.0, 8.0), min_size=5, max_size=30))
def test_no_motion_of_a_hand_is_refused(runs: Runs, device: dict[str, float], speeds: list[float]):
    device["pan"] = 0.0
    run = runs.start(mode="teleop")
    step(run, 3)
    for speed in speeds:
        device["pan"] = float(np.clip(device["pan"] + speed * PERIOD_S, -1, 1))
        step(run)
    step(run, 2)

    assert run.session.faults == ()
    run.stop()
