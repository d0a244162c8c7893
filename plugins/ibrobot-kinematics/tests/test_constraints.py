"""Path constraints: their options, their derivatives, and projections onto them, against MuJoCo's kinematics."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicModel, PathConstraints, Target, ToolConstraints, read_mjcf
from ibrobot_kinematics.path_constraints import AXES, direction

from ibrobot_core.api import Vector

from .arms import FIVE, SIX, bent, by_mujoco, write_arm

REGION = (0.1, -0.25, -0.2, 0.45, 0.25, 0.3)
lengths = st.floats(-0.3, 0.3)
points = st.tuples(lengths, lengths, lengths)
named = st.sampled_from(AXES)
axes = st.one_of(named, points.filter(lambda axis: math.hypot(*axis) > 0.01))


@st.composite
def constraints(draw: st.DrawFn) -> PathConstraints:
    """One to three constraints."""
    which = draw(st.sets(st.sampled_from(["upright", "region", "view"]), min_size=1))
    values: dict[str, Any] = {}
    if "upright" in which:
        values |= {"upright": draw(st.floats(0.05, 1.0)), "upright_axis": draw(st.one_of(st.none(), axes))}
    if "region" in which:
        values["region"] = REGION
    if "view" in which:
        values |= {"view": draw(points), "view_angle": draw(st.floats(0.1, 1.0))}
        values |= {"view_axis": draw(axes), "view_from": draw(points)}
    return PathConstraints(**values)


@pytest.fixture(scope="module", params=[FIVE, SIX], ids=["five joints", "six joints"])
def arm(request, tmp_path_factory) -> tuple[Path, KinematicModel]:
    path = write_arm(tmp_path_factory.mktemp("arm"), *request.param)
    return path, read_mjcf(path).chain("tool", request.param)


def within(model: KinematicModel, shares: list[float]) -> Vector:
    """A configuration within the limits."""
    return np.asarray(model.lower + np.array(shares[: len(model.lower)]) * (model.upper - model.lower))


def measured(given: PathConstraints, path: Path, model: KinematicModel, q: Vector) -> list[float]:
    """By how much each constraint is exceeded, from the pose of the tool that MuJoCo computes."""
    tip, _ = by_mujoco(path, model, q)
    found = []
    if given.upright is not None:
        assert given.upright_axis is not None
        found.append(math.acos(np.clip((tip.rotation @ direction(given.upright_axis))[2], -1, 1)) - given.upright)
    if given.region is not None:
        found += [*(tip.position - given.region[3:]).tolist(), *(given.region[:3] - tip.position).tolist()]
    if given.view is not None:
        way = np.array(given.view) - tip.position - tip.rotation @ given.view_from
        cosine = tip.rotation @ direction(given.view_axis) @ way / np.linalg.norm(way)
        found.append(math.acos(np.clip(cosine, -1, 1)) - given.view_angle)
    return found


shares = st.lists(st.floats(0, 1), min_size=7, max_size=7)


@settings(deadline=None, max_examples=60)
@given(given_=constraints(), where=shares)
def test_excess_is_that_of_another_engine(arm, given_: PathConstraints, where):
    path, model = arm
    tool = ToolConstraints(given_, model, bent(model))
    q = within(model, where)
    np.testing.assert_allclose(tool.excess(q), measured(tool.given, path, model, q), atol=1e-6)


@settings(deadline=None, max_examples=60)
@given(given_=constraints(), where=shares)
def test_rates_are_the_derivatives(arm, given_: PathConstraints, where):
    model = arm[1]
    tool = ToolConstraints(given_, model, bent(model))
    q, small = within(model, where), 1e-6
    _, rates = tool.excess_and_rates(q)
    steps = small * np.eye(len(q))[model.moving]
    differences = (tool.excess(q + steps) - tool.excess(q - steps)).T / (2 * small)
    # Where the angle is 0 or half a turn, or the camera is at the point, there is no derivative.
    smooth = np.abs(tool.excess(q + 50 * steps) - 2 * tool.excess(q) + tool.excess(q - 50 * steps)).max(axis=0) < 1e-7
    np.testing.assert_allclose(rates[smooth], differences[smooth], atol=2e-4)
    assert rates.shape == (tool.number, len(model.moving))


@settings(deadline=None, max_examples=60)
@given(given_=constraints(), seed=st.integers(0, 2**32 - 1))
def test_projections_keep_the_constraints_and_the_limits(arm, given_: PathConstraints, seed: int):
    path, model = arm
    tool = ToolConstraints(given_, model, bent(model))
    q = np.random.default_rng(seed).uniform(model.lower, model.upper, (8, len(model.lower)))
    near, done = tool.projected(q)
    kept = tool.kept(q)
    np.testing.assert_array_equal(near[kept], q[kept])
    assert done[kept].all()
    assert (near >= model.lower).all()
    assert (near <= model.upper).all()
    np.testing.assert_array_equal(near[:, -1], q[:, -1], "the gripper does not move the tool")
    for each in near[done]:
        assert max(measured(tool.given, path, model, each)) <= 1e-9


def test_most_projections_succeed(arm):
    model = arm[1]
    q = np.random.default_rng(0).uniform(model.lower, model.upper, (200, len(model.lower)))
    for given_ in (PathConstraints(upright=0.17, upright_axis="-x"), PathConstraints(region=REGION)):
        assert tool_of(given_, model).projected(q)[1].mean() > 0.8


def tool_of(given_: PathConstraints, model: KinematicModel) -> ToolConstraints:
    return ToolConstraints(given_, model, bent(model))


@pytest.mark.parametrize("axis", [None, "of the goal"])
def test_projections_meet_a_target(arm, axis):
    path, model = arm
    level = bent(model)
    level[model.joint_names.index("flex")] = -level[1] - level[2]  # the tool points ahead, level
    tip = model.forward(level)
    target = Target(tip.position, axis=None if axis is None else tip.rotation[:, 2])
    tool = ToolConstraints(PathConstraints(upright=0.3), model, level)
    assert tool.given.upright_axis == "-x"
    q = np.random.default_rng(0).uniform(model.lower, model.upper, (60, len(level)))
    near, done = tool.projected(q, target)
    assert done.sum() >= 3
    for each in near[done]:
        assert max(measured(tool.given, path, model, each)) <= 1e-9
        off, turned = target.missed(model.forward(each))
        assert off < 1e-5
        assert turned < 1e-4


def test_words_name_the_constraint_the_value_and_the_bound(arm):
    model = arm[1]
    q = bent(model)
    z = model.forward(q).position[2]
    low = tool_of(PathConstraints(region=(-1, -1, z + 0.01, 1, 1, z + 0.2)), model)
    assert low.broken(q) == f"region: the tool is at z = {z:.4f} m, must be above its lower z, {z + 0.01:.4f} m"
    assert tool_of(PathConstraints(region=(-1, -1, -1, 1, 1, 1)), model).broken(q) == ""
    off = math.degrees(math.acos(model.forward(q).rotation[2, 1]))
    tilted = tool_of(PathConstraints(upright=math.radians(10), upright_axis=(0, 2, 0)), model)
    words = f"upright: the tool's [0, 2, 0] axis is {off:.2f} degrees from the vertical, 10.00 are allowed"
    assert tilted.broken(q) == words
    away = tool_of(PathConstraints(view=(-1, 0, 0.5), view_angle=0.1), model).broken(q)
    assert away.startswith("view: (-1, 0, 0.5) m is 1")
    assert away.endswith("degrees from the camera's axis, 5.73 are allowed")


def test_joint_that_drives_a_constraint_is_named(arm):
    model = arm[1]
    tool = tool_of(PathConstraints(upright=0.05, upright_axis="z"), model)
    velocity = np.zeros(len(model.lower))
    velocity[model.joint_names.index("flex")], velocity[0] = 0.1, 3.0
    assert tool.moved_by(bent(model), velocity) == "flex", "the pan does not tilt"


NUMBERS = "must be numbers from -1e+06 to 1e+06"
BAD: list[tuple[dict[str, Any], str]] = [
    ({}, "path constraints have at least one of upright, region, view; there is none"),
    ({"upright": 0.0}, "0.0 is too small, must be above 0 rad"),
    ({"upright": 3.2}, "3.2 is too large, must be below 3.14"),
    ({"upright": math.nan}, "nan is too small"),
    ({"upright_axis": "z", "region": REGION}, "upright_axis needs upright, the largest angle from the vertical"),
    ({"upright": 0.1, "upright_axis": (0.0, 0.0, 0.0)}, "upright_axis has no length; give a direction"),
    ({"upright": 0.1, "upright_axis": (0.0, math.inf, 0.0)}, f"upright_axis {NUMBERS}"),
    ({"region": (0, 0, 0, 1, 0, 1)}, "region: the lower y is 0, must be below the upper y, 0"),
    ({"region": (0, 0, math.nan, 1, 1, 1)}, f"region {NUMBERS}"),
    ({"view": (0, 0, 1e7)}, f"view {NUMBERS}"),
    ({"view": (0, 0, 1), "view_angle": 0.0}, "0.0 is too small"),
    ({"upright": 0.1, "view_angle": 0.2}, "view_angle needs view, the point to keep in view"),
    ({"upright": 0.1, "view_from": (0, 0, 0.1)}, "view_from needs view, the point to keep in view"),
]


@pytest.mark.parametrize(("values", "message"), BAD)
def test_constraints_that_make_no_sense_are_refused(values: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message.replace("+", r"\+")):
        PathConstraints(**values)


@given(axis=st.tuples(*[st.floats(-1e6, 1e6)] * 3).filter(lambda axis: math.hypot(*axis) > 0))
def test_directions_have_length_one(axis):
    assert math.hypot(*direction(axis)) == pytest.approx(1.0)
