"""Servo on arms of five and six joints: it follows twists, within all limits, and slows down where it has to."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import (
    KinematicModel,
    PathConstraints,
    Servo,
    ServoOptions,
    ServoStatus,
    ToolConstraints,
    read_mjcf,
)
from ibrobot_kinematics.rotations import log

from ibrobot_core.api import Vector, ns

from .arms import FIVE, SIX, bent, write_arm

DT = 0.01
SPEED, ACCELERATION = 3.0, 40.0
STILL = np.zeros(3)


def load(joints: tuple[str, ...]) -> KinematicModel:
    with tempfile.TemporaryDirectory() as directory:
        return read_mjcf(write_arm(Path(directory), *joints)).chain("tool", joints)


ARMS = {len(joints): load(joints) for joints in (FIVE, SIX)}


@pytest.fixture(params=ARMS.values(), ids=["five joints", "six joints"])
def model(request) -> KinematicModel:
    return request.param


@attrs.define
class Rig:
    """A servo and its clock."""

    model: KinematicModel
    options: ServoOptions = ServoOptions()
    changes: dict[str, Any] = attrs.field(factory=dict)
    start: Vector | None = None
    now_ns: int = ns(1000.0)
    servo: Servo = attrs.field(init=False)
    positions: list[Vector] = attrs.field(factory=list)

    def __attrs_post_init__(self) -> None:
        ones = np.ones(len(self.model.lower))
        self.servo = Servo(self.model, SPEED * ones, ACCELERATION * ones, self.options, **self.changes)
        self.servo.reset(bent(self.model) if self.start is None else self.start)
        self.tick()

    def tick(self) -> Vector:
        self.positions.append(self.servo.step(self.now_ns))
        self.now_ns += ns(DT)
        return self.positions[-1]

    def follow(self, linear: Vector, turn: Vector = STILL, seconds: float = DT, *, in_tool: bool = False) -> Vector:
        """Where a twist leads, its turn about the tool's own axes."""
        for _ in range(round(seconds / DT)):
            rotation = self.model.forward(self.servo.position).rotation
            self.servo.command(linear, turn if in_tool else rotation @ turn, self.now_ns, in_tool=in_tool)
            self.tick()
        return self.positions[-1]

    def rest(self) -> Vector:
        while not self.servo.at_rest:
            self.tick()
        return self.positions[-1]


def turned(model: KinematicModel, before: Vector, after: Vector) -> Vector:
    """The turn between two configurations about the tool's axes [rad], shape (3,)."""
    return log(model.forward(before).rotation.T @ model.forward(after).rotation)


def moved(model: KinematicModel, before: Vector, after: Vector) -> Vector:
    """The way of the tool between two configurations [m], shape (3,)."""
    return model.forward(after).position - model.forward(before).position


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_tool_moves_along_the_axis_and_keeps_pitch_and_roll(model, axis, sign):
    linear = np.zeros(3)
    linear[axis] = sign * 0.1
    rig = Rig(model)
    after = rig.follow(linear, seconds=0.3)
    way = moved(model, bent(model), after)
    assert way[axis] == pytest.approx(sign * 0.03, abs=2e-3)
    np.testing.assert_allclose(np.delete(way, axis), 0, atol=1e-3)
    np.testing.assert_allclose(turned(model, bent(model), after)[1:], 0, atol=0.02)


def test_six_joints_hold_the_heading_too():
    model = ARMS[len(SIX)]
    after = Rig(model).follow(np.array([0, 0.1, 0]), seconds=0.3)
    np.testing.assert_allclose(turned(model, bent(model), after), 0, atol=0.01)


def test_weights_choose_which_turn_gives_way():
    model = ARMS[len(FIVE)]
    lost = []
    for weights in ((0.01, 1.0, 1.0), (1.0, 1.0, 0.01)):
        rig = Rig(model, changes={"turn_weights": weights})
        lost.append(np.abs(turned(model, bent(model), rig.follow(np.array([0, 0.1, 0]), seconds=0.1))))
    heading_free, roll_free = lost
    assert heading_free[0] > 10 * heading_free[2]
    assert roll_free[2] > 10 * heading_free[2]


@pytest.mark.parametrize("axis", [1, 2], ids=["pitch", "roll"])
@pytest.mark.parametrize("in_tool", [False, True], ids=["base frame", "tool frame"])
def test_tool_turns_on_the_spot(model, axis, in_tool):
    turn = np.zeros(3)
    turn[axis] = 0.5
    after = Rig(model).follow(STILL, turn, 0.4, in_tool=in_tool)
    np.testing.assert_allclose(moved(model, bent(model), after), 0, atol=2e-3)
    np.testing.assert_allclose(turned(model, bent(model), after)[1:], 0.4 * turn[1:], atol=0.01)


def test_a_twist_in_the_tool_frame_goes_where_the_tool_points(model):
    after = Rig(model).follow(np.array([0, 0, 0.05]), seconds=0.2, in_tool=True)
    way = moved(model, bent(model), after)
    np.testing.assert_allclose(way, 0.01 * model.forward(bent(model)).rotation[:, 2], atol=1e-3)


def test_only_the_chain_moves(model):
    assert Rig(model).follow(np.array([0.1, 0, 0]), seconds=0.3)[-1] == bent(model)[-1]


@pytest.mark.parametrize("linear", [(0.1, 0, 0), (-0.1, 0, 0), (0, 0, -0.1), (0, 0.1, 0.1)])
def test_at_the_edge_of_its_reach_the_tool_stops_and_comes_back(model, linear):
    rig = Rig(model)
    rig.follow(np.array(linear), seconds=6)
    away = rig.rest()
    assert np.all(np.abs(away) <= 1.6)
    np.testing.assert_allclose(rig.follow(np.array(linear), seconds=0.3), away, atol=5e-3)
    back = moved(model, away, rig.follow(-np.array(linear), seconds=2))
    assert back @ -np.array(linear) / np.linalg.norm(linear) > 0.06


def test_when_twists_stop_coming_the_arm_slows_down_to_a_stop(model):
    rig = Rig(model)
    rig.follow(np.array([0, 0, 0.2]), seconds=0.3)
    last = len(rig.positions)
    rig.rest()
    speeds = np.abs(np.diff(rig.positions[last - 1 :], axis=0)).max(axis=1) / DT
    assert len(speeds) <= 0.1 / DT + 10
    # For the timeout it goes on, then it brakes.
    assert speeds[0] > 0.1
    assert speeds[round(0.1 / DT) - 2] > 0.1
    assert speeds[-1] < ACCELERATION * DT
    assert rig.servo.status is ServoStatus.NO_WARNING


def assert_within_limits(rig: Rig, lower: Vector, upper: Vector) -> None:
    positions = np.array(rig.positions)
    velocities = np.diff(positions, axis=0, prepend=positions[:1]) / DT
    accelerations = np.diff(velocities, axis=0) / DT
    assert np.all((positions >= lower - 1e-9) & (positions <= upper + 1e-9))
    assert np.abs(velocities).max() <= SPEED + 1e-6
    assert np.abs(accelerations).max() <= ACCELERATION + 1e-4


directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
commands = st.tuples(
    directions.map(lambda v: 0.57 * v), directions.map(lambda v: 3 * v), st.booleans(), st.floats(0, 0.4)
)


@settings(deadline=None, max_examples=20)
@given(shares=st.lists(st.floats(0, 1), min_size=7, max_size=7), orders=st.lists(commands, max_size=4))
def test_no_twist_exceeds_a_limit_of_a_joint(shares, orders):
    for number, model in ARMS.items():
        start = model.lower + np.array(shares[:number]) * (model.upper - model.lower)
        rig = Rig(model, start=start)
        for linear, turn, in_tool, seconds in orders:
            rig.follow(linear, turn, seconds, in_tool=in_tool)
            for _ in range(int(100 * seconds) % 20):
                rig.tick()
        rig.rest()
        rig.tick()
        rig.tick()
        assert_within_limits(rig, model.lower, model.upper)


def test_a_twist_too_fast_for_the_joints_goes_slower_on_the_same_way():
    model = ARMS[len(SIX)]
    rig = Rig(model)
    way = moved(model, bent(model), rig.follow(np.array([0.6, 0.0, 0.6]), seconds=0.08))
    np.testing.assert_allclose(way / np.linalg.norm(way), np.array([1, 0, 1]) / np.sqrt(2), atol=0.05)
    assert_within_limits(rig, model.lower, model.upper)


def test_arm_outside_its_limits_moves_inwards_without_a_jump(model):
    start = bent(model)
    start[0] = 1.8
    rig = Rig(model, start=start)
    rig.follow(np.array([0, 0, 0.1]), seconds=0.3)
    rig.rest()
    first = np.array(rig.positions)[:, 0]
    assert np.all(np.diff(first) <= 1e-12)
    assert np.abs(np.diff(rig.positions, axis=0)).max() <= SPEED * DT


def test_a_singularity_slows_the_tool_and_lets_it_leave(model):
    rig = Rig(model)
    seen = set()
    for _ in range(400):
        rig.follow(np.array([0.1, 0, 0]))
        seen.add(rig.servo.status)
    assert seen & {ServoStatus.DECELERATE_FOR_APPROACHING_SINGULARITY, ServoStatus.JOINT_BOUND}
    stretched = rig.rest()
    rig.follow(np.array([-0.1, 0, 0]), seconds=3)
    assert moved(model, stretched, rig.positions[-1])[0] < -0.05


def test_thresholds_decide_where_it_stops():
    model = ARMS[len(FIVE)]
    reach = []
    for hard_stop in (15.0, 100.0):
        rig = Rig(model, ServoOptions(lower_singularity_threshold=10, hard_stop_singularity_threshold=hard_stop))
        rig.follow(np.array([0.1, 0, 0]), seconds=5)
        reach.append(model.forward(rig.rest()).position[0])
    assert reach[0] < reach[1] - 0.005


def test_an_obstacle_slows_the_tool_stops_it_and_lets_it_leave(model):
    wall = model.forward(bent(model)).position[0] + 0.03

    def clearance(q: Vector) -> float:
        return float(wall - model.forward(q).position[0])

    rig = Rig(model, ServoOptions(slow_distance=0.02, stop_distance=0.005), changes={"clearance": clearance})
    seen = []
    for _ in range(200):
        rig.follow(np.array([0.1, 0, 0]))
        seen.append(rig.servo.status)
    assert ServoStatus.DECELERATE_FOR_COLLISION in seen
    before = clearance(rig.rest())
    assert 0.004 < before < 0.01
    after = clearance(rig.follow(np.array([-0.1, 0, 0]), seconds=0.3))
    assert after > before + 0.02
    assert rig.servo.status is ServoStatus.NO_WARNING


def test_a_host_that_stood_still_does_not_leap(model):
    rig = Rig(model)
    before = rig.follow(np.array([0.2, 0, 0]), seconds=0.2)
    rig.now_ns += ns(0.5)
    rig.servo.command(np.array([0.2, 0, 0]), STILL, rig.now_ns)
    np.testing.assert_array_equal(rig.tick(), before)
    assert np.abs(rig.tick() - before).max() <= ACCELERATION * DT * DT + 1e-9


NAN, BIG = np.array([0.0, np.nan, 0.0]), np.array([0.0, 0.0, 50.0])
REFUSED = {
    "not a number": (NAN, STILL, "not finite"),
    "turn not a number": (STILL, NAN, "not finite"),
    "infinite": (np.array([np.inf, 0, 0]), STILL, "not finite"),
    "too fast": (BIG, STILL, "faster than 1 m/s"),
    "turns too fast": (STILL, BIG, "turns faster than 6 rad/s"),
    "too few": (np.zeros(2), STILL, "not three numbers each"),
    "a number": (np.array(0.1), STILL, "not three numbers each"),
}


@pytest.mark.parametrize(("linear", "angular", "reason"), REFUSED.values(), ids=REFUSED.keys())
def test_twists_that_make_no_sense_are_refused_and_counted(model, linear, angular, reason):
    rig = Rig(model)
    rig.follow(np.array([0.1, 0, 0]), seconds=0.05)
    assert rig.servo.command(linear, angular, rig.now_ns) == reason
    assert rig.servo.status is ServoStatus.INVALID
    assert rig.servo.refused == {reason: 1}
    rig.rest()
    assert np.isfinite(rig.positions).all()
    assert_within_limits(rig, model.lower, model.upper)


BAD = [
    ({"lower_singularity_threshold": 200.0}, "lower_singularity_threshold is 200, must be below hard_stop_singularity"),
    ({"stop_distance": 0.1}, "stop_distance is 0.1, must be below slow_distance, which is 0.05"),
    ({"timeout": 0.0}, "0.0 is too small, must be above 0 s"),
    ({"joint_limit_margin": -1.0}, "-1.0 is too small, must be above 0 rad"),
    ({"max_linear": float("nan")}, "nan is too small, must be above 0 m/s"),
]


@pytest.mark.parametrize(("options", "message"), BAD)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        ServoOptions(**options)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ((np.ones(2), np.ones(6)), r"max_velocity must be above 0 with shape \(6,\), got \[1.0, 1.0\]"),
        ((np.ones(6), np.zeros(6)), "max_acceleration must be above 0"),
        ((np.full(6, np.nan), np.ones(6)), "max_velocity must be above 0"),
    ],
)
def test_limits_that_make_no_sense_are_refused(limits, message):
    with pytest.raises(ValueError, match=message):
        Servo(ARMS[len(FIVE)], *limits)


@pytest.mark.parametrize("position", [np.zeros(3), np.full(6, np.nan)])
def test_no_arm_stands_at_a_position_that_makes_no_sense(position):
    with pytest.raises(ValueError, match=r"position must be finite with shape \(6,\)"):
        Rig(ARMS[len(FIVE)]).servo.reset(position)


def level(model: KinematicModel) -> Vector:
    """As `bent`, with the tool level."""
    q = bent(model)
    q[[model.joint_names.index(name) for name in ("roll", "flex")]] = 0.0, -q[1] - q[2]
    return q


def constrained(model: KinematicModel, **values: Any) -> tuple[Rig, ToolConstraints]:
    given_ = PathConstraints(**({"upright_axis": "-x"} if "upright" in values else {}) | values)
    start = level(model)
    return Rig(model, ServoOptions(path_constraints=given_), start=start), ToolConstraints(given_, model, start)


def region(model: KinematicModel, room: float = 0.04) -> tuple[float, ...]:
    here = model.forward(level(model)).position
    return (*(here - room).tolist(), *(here + room).tolist())


TOWARDS_THE_POINT = [(np.array([0, 0.285, 0]), STILL, False, 0.25), (np.array([0.57, 0, 0]), STILL, True, 0.25)]
"""The nearer the point, the faster its direction turns."""


@example(orders=TOWARDS_THE_POINT, kind="view")
@settings(deadline=None, max_examples=15, phases=[Phase.explicit, Phase.generate])
@given(orders=st.lists(commands, min_size=1, max_size=6), kind=st.sampled_from(["upright", "region", "view", "all"]))
def test_no_twist_breaks_a_path_constraint_or_a_limit(orders, kind):
    for model in ARMS.values():
        ahead = model.forward(level(model))
        values: dict[str, Any] = {}
        if kind in ("upright", "all"):
            values["upright"] = 0.17
        if kind in ("region", "all"):
            values["region"] = region(model)
        if kind in ("view", "all"):
            values |= {"view": tuple((ahead.position + 0.3 * ahead.rotation[:, 2]).tolist()), "view_angle": 0.2}
        rig, tool = constrained(model, **values)
        for linear, turn, in_tool, seconds in orders:
            rig.follow(linear, turn, seconds, in_tool=in_tool)
            for _ in range(int(100 * seconds) % 20):
                rig.tick()
        rig.rest()
        rig.tick()
        rig.tick()
        excess = tool.excess(np.array(rig.positions)).max(axis=0)
        assert (excess <= 0).all(), f"{kind}: {excess}"
        assert_within_limits(rig, model.lower, model.upper)


def test_tool_slows_down_before_the_bound_and_comes_back(model):
    rig, _ = constrained(model, region=region(model))
    start = rig.positions[-1]
    upwards, speeds = np.array([0, 0, 0.2]), []
    for _ in range(100):
        before = rig.positions[-1]
        speeds.append(moved(model, before, rig.follow(upwards))[2] / DT)
    top = region(model)[5]
    assert 0.8 * 0.04 < moved(model, start, rig.positions[-1])[2] < 0.04
    assert max(speeds) > 0.1
    assert 0 <= speeds[-1] < 0.002, "it creeps at the bound"
    statuses = [rig.servo.status]
    assert model.forward(rig.follow(-upwards, seconds=0.2)).position[2] < top - 0.01
    statuses.append(rig.servo.status)
    assert statuses == [ServoStatus.JOINT_BOUND, ServoStatus.NO_WARNING]


def test_tool_slides_along_a_bound(model):
    rig, _ = constrained(model, region=region(model))
    rig.follow(np.array([0, 0, 0.2]), seconds=1.0)
    before = rig.positions[-1]
    way = moved(model, before, rig.follow(np.array([0, 0.1, 0.1]), seconds=0.2))
    assert way[1] > 0.008
    assert 0 <= way[2] < 0.002


def test_tool_that_starts_beyond_a_bound_only_moves_back(model):
    rig, _ = constrained(model, upright=0.1, upright_axis="-x")
    tilted = level(model)
    tilted[model.joint_names.index("flex")] += 0.3
    rig.servo.reset(tilted)
    tool = ToolConstraints(PathConstraints(upright=0.1, upright_axis="-x"), model, tilted)
    rig.follow(STILL, np.array([0, 1.0, 0]), 0.3)
    rig.follow(STILL, np.array([0, -1.0, 0]), 0.6)
    rig.follow(STILL, np.array([0, 1.0, 0]), 0.3)
    excess = tool.excess(np.array(rig.positions[1:]))[:, 0]
    assert excess[0] > 0.1
    assert (np.diff(excess)[excess[:-1] > 0] <= 1e-9).all()
    assert excess[-1] < 0
