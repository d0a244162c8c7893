"""Closed-form inverse kinematics: all branches reach the target within limits, for any arm of that geometry."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import (
    KinematicModel,
    Target,
    UnreachableError,
    read_mjcf,
    solve,
    solve_all,
)

from ibrobot_core.api import Vector

from .arms import FIVE, write_arm

JOINTS = ("a", "b", "c", "d", "e")
SHARES = st.lists(st.floats(0.02, 0.98), min_size=5, max_size=5).map(np.array)


def build(
    limit: float,
    *,
    signs: tuple[int, ...] = (1, 1, 1, 1, 1),
    euler: str = "0 0 0",
    aside: float = -0.0002,
    off: str = "0.012 0.001",
) -> KinematicModel:
    """An arm like the SO-101 with names that say nothing; its tool points along the forearm."""
    axes = ("0 0 {}", "0 {} 0", "0 {} 0", "0 {} 0", "{} 0 0")
    places = ("0.04 0.01 0.06", "0.03 0 0.05", "0.03 0 0.11", "0.135 0 0.005", f"0.06 {aside} 0")
    bodies = ""
    for name, axis, sign, place in zip(JOINTS, axes, signs, places, strict=True):
        bodies += f'<body pos="{place}"><geom size="0.01"/>'
        bodies += f'<joint name="{name}" axis="{axis.format(sign)}" range="{-limit} {limit}" limited="true"/>'
    bodies += f'<site name="tool" pos="0.1 {off}" xyaxes="0 0 -1 0 1 0"/>' + "</body>" * 5
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "arm.xml"
        path.write_text(
            f'<mujoco><compiler angle="radian"/><worldbody><body euler="{euler}">{bodies}</body></worldbody></mujoco>'
        )
        return read_mjcf(path).chain("tool", JOINTS)


ARM = build(1.7)
ROOMY = build(3.1)


@st.composite
def arms(draw: st.DrawFn) -> KinematicModel:
    return build(
        draw(st.sampled_from([1.7, 3.1])),
        signs=tuple(draw(st.tuples(*[st.sampled_from([1, -1])] * 5))),
        euler=draw(st.sampled_from(["0 0 0", "0.3 -0.4 1", "3.14159265 0 0"])),
        aside=draw(st.sampled_from([0.0, -0.0002, 0.02])),
        off=draw(st.sampled_from(["0 0", "0.012 0.001", "-0.002 -0.03"])),
    )


def within(model: KinematicModel, share: Vector) -> Vector:
    return np.asarray(model.lower + share * (model.upper - model.lower))


def target_at(model: KinematicModel, q: Vector, with_axis: bool, digits: int | None = None) -> Target:
    tip = model.forward(q)
    position, axis = tip.position, tip.rotation[:, 2]
    if digits is not None:
        position, axis = np.round(position, digits), np.round(axis, digits)
    return Target(position, axis=axis / np.linalg.norm(axis) if with_axis else None)


def assert_reached(model: KinematicModel, target: Target, q: Vector, tolerance: float, turn: float) -> None:
    tip = model.forward(q)
    assert np.linalg.norm(tip.position - target.position) <= tolerance
    if target.axis is not None:
        assert np.linalg.norm(tip.rotation[:, 2] - target.axis) <= turn
    assert np.all(q >= model.lower)
    assert np.all(q <= model.upper)


@pytest.mark.parametrize("with_axis", [False, True], ids=["position", "axis"])
@settings(deadline=None, max_examples=60)
@given(model=arms(), there=SHARES, here=SHARES)
def test_every_branch_reaches_the_target_nearest_first(
    model: KinematicModel, with_axis: bool, there: Vector, here: Vector
):
    target, start = target_at(model, within(model, there), with_axis), within(model, here)
    solutions = solve_all(model, target, start, position_tolerance=1e-5, rotation_tolerance=1e-4)
    for q in solutions:
        assert_reached(model, target, q, 1e-5, 1e-4)
    distances = [np.linalg.norm(q - start) for q in solutions]
    assert (np.diff(distances) >= -1e-12).all()


@settings(deadline=None, max_examples=60)
@given(share=SHARES)
def test_the_configuration_itself_is_among_the_branches(share: Vector):
    q = within(ARM, share)
    tip = ARM.forward(q)
    if np.hypot(*tip.rotation[:2, 2]) < 0.03:
        return  # the pan is free there, and sampled
    nearest = solve_all(ARM, Target(tip.position, axis=tip.rotation[:, 2]), q)[0]
    assert np.abs(nearest - q).max() < 1e-3


def test_a_roomy_arm_has_eight_branches():
    target = target_at(ROOMY, np.array([0.3, -1.2, -2.3, -2.4, 0.4]), with_axis=True)
    solutions = solve_all(ROOMY, target)
    assert len(solutions) == 8
    assert min(np.abs(p - q).max() for i, p in enumerate(solutions) for q in solutions[:i]) > 0.01


@pytest.mark.parametrize("with_axis", [False, True], ids=["position", "axis"])
@settings(deadline=None, max_examples=60)
@given(share=SHARES)
def test_rounded_targets_are_reached(with_axis: bool, share: Vector):
    target = target_at(ARM, within(ARM, share), with_axis, digits=4)
    assert_reached(ARM, target, solve(ARM, target, np.zeros(5)), 1e-3, 1e-2)


@pytest.mark.parametrize("digits", [None, 4], ids=["exact", "rounded"])
@settings(deadline=None, max_examples=60)
@given(pan=st.floats(-1.6, 1.6), lift=st.floats(-1.0, 1.5), elbow=st.floats(-1.5, 1.5), roll=st.floats(-1.6, 1.6))
def test_a_vertical_tool_leaves_the_pan_free(digits: int | None, pan: float, lift: float, elbow: float, roll: float):
    q = np.array([pan, lift, elbow, np.pi / 2 - lift - elbow, roll])
    if abs(q[3]) > ARM.upper[3]:
        return
    target = target_at(ARM, q, with_axis=True, digits=digits)
    found = solve(ARM, target, np.zeros(5))
    assert_reached(ARM, target, found, 1e-6 if digits is None else 1e-3, 1e-6 if digits is None else 1e-2)


@pytest.mark.parametrize("axis", [None, np.array([0.0, 0.6, -0.8])], ids=["position", "axis"])
def test_an_unreachable_target_comes_with_the_nearest_point(axis: Vector | None):
    target = Target(np.array([0.6, 0.6, 0.2]), axis=axis)
    with pytest.raises(UnreachableError, match="cannot reach") as e:
        solve_all(ARM, target)
    tip = ARM.forward(e.value.nearest)
    assert np.linalg.norm(tip.position - target.position) == pytest.approx(e.value.position_error)
    assert np.all((ARM.lower <= e.value.nearest) & (e.value.nearest <= ARM.upper))
    rng = np.random.default_rng(0)
    others = (ARM.forward(within(ARM, share)).position for share in rng.random((2000, 5)))
    assert e.value.position_error <= min(np.linalg.norm(other - target.position) for other in others)


def test_joints_off_the_chain_stay(tmp_path: Path):
    five = read_mjcf(write_arm(tmp_path, *FIVE)).chain("tool", FIVE)
    start = np.full(6, 0.4)
    assert all(q[-1] == start[-1] for q in solve_all(five, Target(five.forward(start).position), start))
