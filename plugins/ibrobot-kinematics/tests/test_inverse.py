"""Inverse kinematics: solutions are at the target and within limits, and what cannot be reached is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_kinematics import KinematicModel, Target, UnreachableError, read_mjcf, solve, solve_all

from ibrobot_core.api import Vector

from .arms import FIVE, SIX, bent, write_arm

KINDS = ("position", "axis", "rotation")


@pytest.fixture(scope="module", params=[FIVE, SIX], ids=["five joints", "six joints"])
def model(request, tmp_path_factory) -> KinematicModel:
    return read_mjcf(write_arm(tmp_path_factory.mktemp("arm"), *request.param)).chain("tool", request.param)


def target_at(model: KinematicModel, q: Vector, kind: str) -> Target:
    tip = model.forward(q)
    return Target(
        tip.position,
        rotation=tip.rotation if kind == "rotation" else None,
        axis=tip.rotation[:, 2] if kind == "axis" else None,
    )


def assert_reached(model: KinematicModel, target: Target, q: Vector, tolerance: float) -> None:
    tip = model.forward(q)
    np.testing.assert_allclose(tip.position, target.position, atol=tolerance)
    if target.rotation is not None:
        np.testing.assert_allclose(tip.rotation, target.rotation, atol=2 * tolerance)
    if target.axis is not None:
        np.testing.assert_allclose(tip.rotation[:, 2], target.axis, atol=2 * tolerance)
    assert np.all(q >= model.lower)
    assert np.all(q <= model.upper)


@pytest.mark.parametrize("kind", KINDS)
def test_what_forward_gives_is_reached_from_the_middle(model: KinematicModel, kind: str):
    rng = np.random.default_rng(1)
    for _ in range(60):
        q = model.lower + rng.uniform(0.05, 0.95, len(model.lower)) * (model.upper - model.lower)
        target = target_at(model, q, kind)
        found = solve(model, target, np.zeros(len(q)), position_tolerance=1e-5, rotation_tolerance=2e-4)
        assert_reached(model, target, found, 2e-4)
        assert found[-1] == 0.0, "the jaw does not move the tip"


@pytest.mark.parametrize("kind", KINDS)
def test_solution_is_near_the_start(model: KinematicModel, kind: str):
    q = bent(model)
    found = solve(model, target_at(model, q, kind), q + 0.05)
    assert np.abs(found - q).max() < 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_start_outside_the_limits_is_allowed(model: KinematicModel, kind: str):
    target = target_at(model, bent(model), kind)
    assert_reached(model, target, solve(model, target, bent(model) + 2.0), 0.02)


def test_tip_that_points_away_from_the_axis_is_turned_around(tmp_path: Path):
    """Where the axes are opposite there is no shortest turn."""
    model = read_mjcf(write_arm(tmp_path, *SIX)).chain("tool", SIX)
    model = attrs.evolve(model, lower=np.full(7, -4.0), upper=np.full(7, 4.0))
    target = Target([0.0, 0.2, 0.2], axis=-model.forward(np.zeros(7)).rotation[:, 2])
    assert_reached(model, target, solve(model, target, np.zeros(7)), 0.02)


def test_equal_arguments_give_equal_bits(model: KinematicModel):
    target = target_at(model, bent(model), "axis")
    start = np.full(len(model.lower), 1.0)
    np.testing.assert_array_equal(solve(model, target, start), solve(model, target, start))


def test_out_of_reach_tells_the_nearest(model: KinematicModel):
    message = r"tool cannot reach \(2.000, 0.000, 0.100\) m as asked .*; the nearest is \(.*\) m, \d+\.\d mm off"
    with pytest.raises(UnreachableError, match=message) as e:
        solve(model, Target([2.0, 0.0, 0.1]), bent(model))
    error = e.value
    tip = model.forward(error.nearest)
    assert np.linalg.norm(tip.position - [2.0, 0.0, 0.1]) == pytest.approx(error.position_error)
    straight = model.forward(np.zeros(len(model.lower))).position
    assert error.position_error == pytest.approx(np.linalg.norm(straight - [2.0, 0.0, 0.1]), abs=1e-3)
    assert error.rotation_error == 0


def test_five_joints_reach_a_pose_only_with_tolerance(tmp_path: Path):
    model = read_mjcf(write_arm(tmp_path, *FIVE)).chain("tool", FIVE)
    sideways = Target([0.3, 0.1, 0.1], rotation=np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]))
    with pytest.raises(
        UnreachableError, match=r"the nearest is \(0.300, 0.100, 0.100\) m, 0.0 mm and 89.5 degrees off"
    ) as e:
        solve(model, sideways, bent(model))
    found = solve(model, sideways, bent(model), rotation_tolerance=e.value.rotation_error + 0.01)
    np.testing.assert_allclose(model.forward(found).position, sideways.position, atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"position": [0.0, 1.0]}, r"position must be finite with shape \(3,\)"),
        ({"position": [0.0, 1.0, np.nan]}, "position must be finite"),
        ({"rotation": np.ones((3, 3))}, "must be a rotation matrix"),
        ({"rotation": -np.eye(3)}, "must be a rotation matrix"),
        ({"rotation": np.eye(2)}, r"rotation must be finite with shape \(3, 3\)"),
        ({"axis": np.array([0.0, 0.0, 2.0])}, "must be a unit vector"),
        ({"axis": np.array([0.0, 0.0, 1.0]), "rotation": np.eye(3)}, "a rotation or an axis, not both"),
    ],
)
def test_target_that_makes_no_sense_is_refused(arguments: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        Target(**({"position": [0.0, 0.0, 0.1]} | arguments))


@pytest.mark.parametrize("far", [10.0, 1e3, 1e9, 1e155, 1e308])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("search", [solve, solve_all])
def test_target_beyond_reach_by_any_factor_is_refused_with_the_nearest_point(model, far: float, kind: str, search):
    q = bent(model)
    target = attrs.evolve(target_at(model, q, kind), position=np.array([far, 0.0, 0.0]))
    with pytest.raises(UnreachableError) as refusal:
        search(model, target, q)
    assert np.isfinite(refusal.value.nearest).all()
    assert refusal.value.position_error == pytest.approx(far, abs=2 * model.reach)
    np.testing.assert_allclose(refusal.value.position, model.forward(refusal.value.nearest).position)
    assert len(str(refusal.value)) < 300
