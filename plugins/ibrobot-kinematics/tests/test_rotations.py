"""Rotations: their forms are one another's inverses for every angle, half a turn and tiny ones included."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from ibrobot_kinematics.poses import matrix, pose, pose_at
from ibrobot_kinematics.rotations import between, cross, exp, from_quaternion, from_rpy, log, quaternion, rpy, skew

from ibrobot_core.api import Vector

turns = st.floats(-np.pi, np.pi)
tiny = st.floats(-12, -1).map(lambda power: 10.0**power)
angles = st.floats(0, np.pi) | tiny | tiny.map(lambda less: np.pi - less) | st.sampled_from([0.0, np.pi])
axes = st.builds(lambda seed: unit(np.random.default_rng(seed).normal(size=3)), st.integers(0, 2**32 - 1))
axes |= st.sampled_from([*np.eye(3), *-np.eye(3), np.array([0.6, 0.8, 0.0])])


def unit(v: Vector) -> Vector:
    return np.asarray(v / np.linalg.norm(v))


@given(axes, angles)
def test_log_undoes_exp(axis: Vector, angle: float):
    rotation = exp(angle * axis)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(exp(log(rotation)), rotation, atol=1e-9)
    assert np.linalg.norm(log(rotation)) == pytest.approx(angle, abs=1e-14)
    if angle < np.pi - 1e-6:
        np.testing.assert_allclose(log(rotation), angle * axis, atol=1e-9)


@given(axes)
def test_log_of_half_a_turn_has_length_pi(axis: Vector):
    vector = log(2 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=1e-12)
    assert abs(unit(vector) @ axis) == pytest.approx(1, abs=1e-12)


@given(st.lists(st.tuples(axes, angles), min_size=1, max_size=5))
def test_log_of_many_is_that_of_each(pairs: list[tuple[Vector, float]]):
    rotations = [exp(angle * axis) for axis, angle in pairs]
    np.testing.assert_array_equal(log(np.array(rotations)), [log(each) for each in rotations])


@given(axes, angles)
@example(np.array([-1.0, 0.0, 0.0]), 3.0)
def test_quaternion_is_of_unit_length_and_undone(axis: Vector, angle: float):
    rotation = exp(angle * axis)
    q = quaternion(rotation)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(q[:3] * np.sign(q[:3] @ axis or 1), np.sin(angle / 2) * axis, atol=1e-14)
    assert q[3] == pytest.approx(np.cos(angle / 2), abs=1e-14)
    np.testing.assert_allclose(from_quaternion(q), rotation, atol=1e-14)
    np.testing.assert_allclose(from_quaternion(-3.0 * q), rotation, atol=1e-14)


@given(turns, turns, turns)
def test_roll_pitch_and_yaw_turn_about_the_fixed_axes_in_order(roll: float, pitch: float, yaw: float):
    x, y, z = np.eye(3)
    rotation = from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(rotation, exp(yaw * z) @ exp(pitch * y) @ exp(roll * x), atol=1e-14)
    np.testing.assert_allclose(from_rpy(*rpy(rotation)), rotation, atol=1e-9)


@given(turns, turns, st.sampled_from([-np.pi / 2, np.pi / 2]))
def test_roll_pitch_and_yaw_of_a_vertical_x_axis(roll: float, yaw: float, pitch: float):
    rotation = from_rpy(roll, pitch, yaw)
    np.testing.assert_allclose(from_rpy(*rpy(rotation)), rotation, atol=1e-9)


@given(axes, axes)
def test_between_leads_from_one_direction_to_the_other(a: Vector, b: Vector):
    turn = between(a, b)
    np.testing.assert_allclose(exp(turn) @ a, b, atol=1e-12)
    angle = 2 * np.arctan2(np.linalg.norm(b - a), np.linalg.norm(b + a))
    assert np.linalg.norm(turn) == pytest.approx(angle, abs=1e-12)


@given(axes, axes, tiny | st.just(0.0), st.sampled_from([1.0, -1.0]))
def test_between_directions_along_nearly_the_same_line(a: Vector, other: Vector, off: float, sign: float):
    b = sign * unit(a + off * other)
    np.testing.assert_allclose(exp(between(a, b)) @ a, b, atol=5e-8)
    assert (np.linalg.norm(between(a, b)) > np.pi / 2) == (sign < 0)


@given(axes, axes)
def test_cross_and_skew_are_the_cross_product(a: Vector, b: Vector):
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=1e-15)
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-15)


@given(st.tuples(turns, turns, turns), st.tuples(turns, turns, turns))
def test_poses_and_matrices_are_the_same(position: tuple[float, ...], angles: tuple[float, ...]):
    placed = matrix(pose_at(position, angles))
    np.testing.assert_allclose(placed[:3, :3], from_rpy(*angles), atol=1e-14)
    np.testing.assert_array_equal(placed[:3, 3], position)
    np.testing.assert_allclose(matrix(pose(placed)), placed, atol=1e-14)
