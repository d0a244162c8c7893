"""What a silence of the host or of the control loop does, in stepped time."""

from __future__ import annotations

import re

import attrs
import numpy as np
import pytest

from ibrobot_core.api import FollowTrajectory, Header, JointTrajectory, JointTrajectoryPoint
from ibrobot_core.control.commands import ClearFaults, SendGoal
from ibrobot_core.schema import InferenceConfig

PEER_TIMEOUT_S = 0.3
ACCELERATION = 40.0
NOT_YET_S = PEER_TIMEOUT_S / 3
"""No shorter silence is a fault, however fast the robot moves."""


def silent(rig, seconds: float) -> str:
    rig.core.note_silence(seconds, "the host has been silent")
    return rig.core.fault


@pytest.fixture
def moving(make_rig):
    rig = make_rig({}).start()
    rig.plan([0.9, 1.4, 0.9], seconds=3.0)
    rig.tick(20)
    return rig


def test_motion_ends_within_the_limit_braking_included(moving):
    at_tick = moving.core.state.tick
    silent_s = 0.0
    while not silent(moving, silent_s):
        silent_s += moving.core.period_ns / 1e9
        moving.tick()
    while not moving.core._safety.at_rest:
        moving.tick()

    assert (moving.core.state.tick - at_tick) * moving.core.period_ns / 1e9 <= PEER_TIMEOUT_S + 0.02
    moving.assert_within_limits()


def test_the_faster_it_moves_the_sooner_it_brakes(make_rig):
    rig = make_rig({}).start()
    rig.plan([0.9, 0.0, 0.0], seconds=0.3)
    rig.tick(10)
    speed = np.abs(rig.core._safety.velocity).max()
    brakes_s = PEER_TIMEOUT_S - speed / ACCELERATION
    assert speed > 2.0

    assert silent(rig, NOT_YET_S) == ""
    assert silent(rig, brakes_s - 0.001) == ""
    assert silent(rig, brakes_s + 0.001).startswith("the host has been silent for")


def test_the_limit_comes_from_the_yaml(make_rig):
    rig = make_rig({"control": {"peer_timeout": 5.0}}).start()
    rig.plan([0.9, 0.0, 0.0], seconds=3.0)
    rig.tick(20)

    assert silent(rig, 4.0) == ""
    assert silent(rig, 5.0)


def test_after_it_nothing_moves_before_a_reset(moving):
    silent(moving, 1.0)
    moving.tick(50)
    held = moving.core.state.command
    moving.plan([0.0, 0.0, 0.0])
    moving.tick(50)
    np.testing.assert_array_equal(moving.core.state.command, held)

    assert moving.call(ClearFaults())["cleared"].startswith("the host has been silent")
    np.testing.assert_array_equal(moving.tick(20).command, moving.core.state.position)


def test_a_robot_that_nobody_commands_needs_no_fault(make_rig):
    rig = make_rig({}).start()
    assert silent(rig, 10.0) == ""
    rig.plan([0.1, 0.0, 0.0], seconds=0.1)
    rig.tick(50)
    assert rig.core._safety.at_rest
    rig.tick(100)

    assert silent(rig, 10.0) == ""


def test_a_robot_at_rest_whose_last_command_is_recent_holds(make_rig):
    rig = make_rig({}).start()
    rig.plan([0.1, 0.0, 0.0], seconds=0.1)
    rig.tick(50)
    assert rig.core._safety.at_rest

    assert silent(rig, 0.3)


def test_a_policy_may_go_on_by_itself_however_long_it_has_waited(make_rig):
    rig = make_rig({}).start()
    stream = rig.config.control_modes["stream"]
    policy = attrs.evolve(stream, inference=InferenceConfig(options=None, model="pick"))
    rig.core._config = attrs.evolve(rig.config, control_modes={**rig.config.control_modes, "stream": policy})
    assert silent(rig, 10.0) == "", "it has not begun"
    rig.plan([0.1, 0.0, 0.0], seconds=0.1)
    rig.tick(300)

    assert silent(rig, PEER_TIMEOUT_S)


def test_a_goal_counts_as_a_command(make_rig):
    rig = make_rig({}).start("plan")
    trajectory = JointTrajectory(Header(), ("pan", "lift"), (JointTrajectoryPoint(0, np.zeros(2)),))
    assert "error" not in rig.call(SendGoal("arm_trajectory", "1", FollowTrajectory(trajectory)))

    assert silent(rig, PEER_TIMEOUT_S)


@pytest.mark.parametrize(
    ("simulated", "stopped", "has"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_silence_of_a_simulation_on_a_busy_machine_names_lockstep(make_rig, simulated, stopped, has):
    rig = make_rig({}).start()
    rig.core._config = attrs.evolve(rig.core._config, simulated=simulated)
    rig.plan([0.9, 1.4, 0.9], seconds=3.0)
    rig.tick(20)
    rig.core.note_silence(1.0, "the host has been silent", stopped=stopped)

    assert re.fullmatch("the host has been silent for 1000 ms(; .* `--lockstep`.*)?", rig.core.fault)
    assert ("--lockstep" in rig.core.fault) == has
