"""Tool jog on arms of five and six joints."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import pytest
from ibrobot_kinematics import KinematicModel, jog, read_mjcf
from ibrobot_kinematics.rotations import log

from ibrobot_core.api import Vector

from .arms import FIVE, SIX, bent, write_arm

DT = 0.01
SPEED = 3.0


def load(directory: Path, joints: tuple[str, ...]) -> KinematicModel:
    return read_mjcf(write_arm(directory, *joints), "tool", joints)


@pytest.fixture(params=[FIVE, SIX], ids=["five joints", "six joints"])
def model(request, tmp_path) -> KinematicModel:
    return load(tmp_path, request.param)


def turned(model: KinematicModel, before: Vector, after: Vector) -> Vector:
    """The turn between two configurations about the tool's axes [rad], shape (3,)."""
    return log(model.forward(before).rotation.T @ model.forward(after).rotation)


def moved(model: KinematicModel, before: Vector, after: Vector) -> Vector:
    """The way of the tool between two configurations [m], shape (3,)."""
    return model.forward(after).position - model.forward(before).position


def jogged(model: KinematicModel, start: Vector, linear: Vector, turn: Vector, ticks: int = 1) -> Vector:
    """Where steps along a velocity in the base frame and a turn about the tool's axes lead."""
    q = start
    for _ in range(ticks):
        q = jog(model, q, linear, model.forward(q).rotation @ turn, DT, np.full(len(q), SPEED))
    return q


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_tool_moves_along_the_axis_and_keeps_pitch_and_roll(model, axis, sign):
    linear = np.zeros(3)
    linear[axis] = sign * 0.1
    start = bent(model)
    after = jogged(model, start, linear, np.zeros(3), 30)
    np.testing.assert_allclose(moved(model, start, after), linear * 0.3, atol=1e-3)
    np.testing.assert_allclose(turned(model, start, after)[1:], 0, atol=0.02)


def test_six_joints_hold_the_heading_too(tmp_path):
    model = load(tmp_path, SIX)
    start = bent(model)
    after = jogged(model, start, np.array([0, 0.1, 0]), np.zeros(3), 30)
    np.testing.assert_allclose(turned(model, start, after), 0, atol=0.01)


def test_weights_choose_which_turn_gives_way(tmp_path):
    model = load(tmp_path, FIVE)
    start, speeds = bent(model), np.full(6, SPEED)
    lost = {}
    for weights in ((0.01, 1.0, 1.0), (1.0, 1.0, 0.01)):
        after = jog(model, start, np.array([0, 0.1, 0]), np.zeros(3), DT, speeds, turn_weights=weights)
        lost[weights] = np.abs(turned(model, start, after))
    heading_free, roll_free = lost.values()
    assert heading_free[0] > 10 * heading_free[2]
    assert roll_free[2] > 10 * heading_free[2]


@pytest.mark.parametrize("axis", [1, 2], ids=["pitch", "roll"])
def test_tool_turns_on_the_spot(model, axis):
    turn = np.zeros(3)
    turn[axis] = 0.5
    start = bent(model)
    after = jogged(model, start, np.zeros(3), turn, 40)
    np.testing.assert_allclose(moved(model, start, after), 0, atol=2e-3)
    np.testing.assert_allclose(turned(model, start, after)[1:], 0.4 * turn[1:], atol=0.01)


def test_only_the_chain_moves(model):
    start = bent(model)
    assert jogged(model, start, np.array([0.1, 0, 0]), np.zeros(3), 30)[-1] == start[-1]


@pytest.mark.parametrize("linear", [(0.1, 0, 0), (-0.1, 0, 0), (0, 0, -0.1), (0, 0.1, 0.1)])
def test_at_the_edge_of_its_reach_the_tool_stops_and_comes_back(model, linear):
    linear = np.array(linear)
    away = jogged(model, bent(model), linear, np.zeros(3), 600)
    assert np.all(np.abs(away) <= 1.6 + 1e-9)
    np.testing.assert_array_equal(jogged(model, away, linear, np.zeros(3), 5), away)
    back = jogged(model, away, -linear, np.zeros(3), 30)
    np.testing.assert_allclose(moved(model, away, back), -0.3 * linear, atol=0.01)


def test_no_joint_goes_faster_than_it_may(model):
    q = bent(model)
    for _ in range(100):
        after = jogged(model, q, np.array([0, 0, 2.0]), np.zeros(3))
        assert np.abs(after - q).max() <= SPEED * DT + 1e-9
        q = after


def test_arm_outside_its_limits_moves_without_a_jump(model):
    start = bent(model)
    start[0] = 1.8
    after = jogged(model, start, np.array([0, 0, 0.1]), np.zeros(3))
    assert 0 < np.abs(after - start).max() <= SPEED * DT
    assert moved(model, start, after)[2] == pytest.approx(0.1 * DT, rel=0.1)


def test_tool_does_not_move_where_the_joints_cannot_follow(tmp_path):
    model = load(tmp_path, FIVE)
    fixed = attrs.evolve(model, lower=np.zeros(6), upper=np.array([0.0, 1.6, 1.6, 1.6, 1.6, 1.6]))
    start = np.zeros(6)
    np.testing.assert_array_equal(jogged(fixed, start, np.array([0, 0.1, 0]), np.zeros(3), 5), start)
