# mypy: disable-error-code="union-attr"
"""Stale means brake: what a stream of setpoints leaves behind when it ends, in stepped time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.control.commands import ClearFaults
from ibrobot_core.interfaces.run_state import PlanRecord
from ibrobot_core.units import ns, seconds
from tests.control.conftest import PERIOD_S, Rig

STALE_S = 0.25
FASTEST, ACCELERATION = 3.0, 40.0
BRAKING_S = FASTEST / ACCELERATION
EDITS = {
    "robot": {
        "name": "long",
        "joints": [
            {"name": name, "lower": -9.0, "upper": 9.0, "max_velocity": FASTEST, "max_acceleration": ACCELERATION}
            for name in ("pan", "lift", "grip")
        ],
        "groups": {"arm": ["pan", "lift"], "gripper": ["grip"]},
    },
    "executors": {
        name: {"type": "position", "group": group, "stale_timeout": STALE_S}
        for name, group in (("arm_position", "arm"), ("gripper_position", "gripper"))
    },
    "control_modes": {"stream": {"executors": ["arm_position", "gripper_position"]}},
}
ALL = np.ones(3, dtype=bool)


def send(rig: Rig, positions: np.ndarray, start_s: float, step_s: float) -> float:
    """Send a plan that starts `start_s` from now; returns when it is stale, from now [s]."""
    start_ns, step_ns = rig.clock.now_ns() + ns(start_s), max(1, ns(step_s))
    rig.core.set_plan(PlanRecord(rig.core.generation, start_ns, step_ns, ALL, positions))
    return start_s + (len(positions) - 1) * seconds(step_ns) + STALE_S


def until_rest(rig: Rig, longest_s: float) -> tuple[float, np.ndarray]:
    """Tick until the command rests for good; returns after how long, and the commands, shape (T, J)."""
    commands = np.array([rig.core.state.command] + [rig.tick().command for _ in range(round(longest_s / PERIOD_S))])
    moving = np.flatnonzero(np.abs(np.diff(commands, axis=0)).max(axis=1) > 0)
    return (0.0 if not len(moving) else (moving[-1] + 1) * PERIOD_S), commands


@pytest.mark.parametrize("far", [2.0, 6.0, 9.0])
def test_one_far_setpoint_moves_the_joint_no_longer_than_the_stale_timeout_and_braking(make_rig, far):
    rig = make_rig(EDITS).start()
    send(rig, np.full((1, 3), far), 0.0, PERIOD_S)
    rest_s, commands = until_rest(rig, 4.0)

    assert rest_s <= STALE_S + BRAKING_S + 2 * PERIOD_S
    assert (commands[-1] - commands[0]).max() <= FASTEST * STALE_S + FASTEST**2 / (2 * ACCELERATION) + 0.01
    assert (np.diff(commands, axis=0) >= 0).all(), "it travels on, and never back"
    rig.assert_within_limits()
    assert rig.core.counters()["executors"]["arm_position"]["stale"] == 1


@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(1, 30), step_s=st.sampled_from([0.0, 0.01, 0.033, 0.1]), start_s=st.floats(-0.2, 0.2),
    ends=st.tuples(*[st.floats(-9, 9)] * 3), renewed=st.integers(1, 40),
)  # fmt: skip
def test_whatever_the_stream_was_the_joints_rest_within_the_stale_timeout_and_braking(
    rows, step_s, start_s, ends, renewed
):
    rig = Rig(EDITS).start()
    send(rig, np.array([ends]), 0.0, 0.0)  # a first, far setpoint, so that the joints are fast
    rig.tick(renewed)
    stale_s = send(rig, np.linspace(rig.core.state.command, ends, rows), start_s, step_s)
    rest_s, _ = until_rest(rig, max(0.0, stale_s) + 1.0)

    assert rest_s <= max(0.0, stale_s) + BRAKING_S + 3 * PERIOD_S
    rig.assert_within_limits()


def test_a_stream_that_comes_back_continues_from_where_the_joints_rest(make_rig):
    rig = make_rig(EDITS).start()
    send(rig, np.full((1, 3), 9.0), 0.0, PERIOD_S)
    rig.tick(60)
    resting = rig.core.state.command
    send(rig, np.vstack([resting, resting - 0.01, resting - 0.02]), -PERIOD_S, PERIOD_S)
    rig.tick(30)

    np.testing.assert_allclose(rig.core.state.command, resting - 0.02, atol=1e-9)
    rig.assert_within_limits()


class TestMeasuredNowhere:
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_a_joint_without_a_finite_reading_is_missing_and_soon_a_fault(self, make_rig, value):
        rig = make_rig(EDITS).start()
        send(rig, np.linspace(np.zeros(3), np.full(3, 1.0), 101), 0.0, PERIOD_S)
        rig.tick(10)
        measure, rig.hardware.read = rig.hardware.read, lambda: _with(measure(), 1, value)
        state = rig.tick()
        assert state.stale
        assert np.isfinite(state.position).all()
        rig.tick(10)

        assert rig.core.fault.startswith(f"joint lift is measured at {value}")
        held = rig.tick(20).command
        rig.hardware.read = measure  # the readings return
        np.testing.assert_array_equal(rig.tick(50).command, held)
        send(rig, np.full((1, 3), 1.0), 0.0, PERIOD_S)
        np.testing.assert_array_equal(rig.tick(50).command, held)  # a reset is needed
        assert rig.call(ClearFaults())["cleared"]

    def test_a_reading_that_is_missing_once_is_no_fault(self, make_rig):
        rig = make_rig(EDITS).start()
        measure, rig.hardware.read = rig.hardware.read, lambda: _with(measure(), 0, np.nan)
        rig.tick(2)
        rig.hardware.read = measure
        rig.tick(20)

        assert rig.core.fault == ""
        assert rig.core.counters()["loop"]["implausible_states"] == 2


def _with(reading, joint, value):
    reading.position[joint] = value
    return reading
