"""The safety layer: its invariants under any stream, what it passes, what it counts, how it stops."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.control.safety import KINDS, SafetyLayer
from ibrobot_core.errors import HardwareError
from ibrobot_core.robot import Joint, Robot, Vector


def make_robot(*limits: tuple[float, float, float, float], max_lead: float | None = None) -> Robot:
    joints = (
        Joint(name=f"j{i}", lower=a, upper=b, max_velocity=v, max_acceleration=c, max_lead=max_lead)
        for i, (a, b, v, c) in enumerate(limits)
    )
    return Robot(name="robot", joints=tuple(joints))


def one_joint(lower: float = -2.0, upper: float = 2.0, velocity: float = 4.0, acceleration: float = 20.0) -> Robot:
    return make_robot((lower, upper, velocity, acceleration))


PERIOD_NS = 10_000_000
ZERO = np.zeros(1)
USABLE = 0.9
"""Largest lead of setpoints of `one_joint` [rad]: its `max_lead` of 1.0 without the reserve."""


class Watched:
    """A real layer, whose every output is checked against the limits.

    The joints reach every setpoint unless a position is given.
    Velocity and acceleration limits may yield only where the measured position leaves no room to brake within the lead.
    """

    def __init__(self, robot: Robot, period_ns: int) -> None:
        self.robot, self.dt = robot, period_ns / 1e9
        self.layer = SafetyLayer(robot, period_ns)

    def start(self, measured: Vector, reset: bool = False) -> None:
        (self.layer.reset if reset else self.layer.activate)(measured)
        self.start_at = measured
        self.before = [measured, measured]
        np.testing.assert_array_equal(self.layer.current, measured)

    def tick(self, desired: Any, measured: Vector | None = None) -> Vector:
        robot, (older, old) = self.robot, self.before
        measured = old if measured is None else measured
        command = self.layer.apply(desired, measured)
        assert command.shape == old.shape
        assert command.dtype == np.float64
        assert np.isfinite(command).all()
        # Inside the limits; a joint that began outside them never moves further out.
        assert (command >= np.minimum(robot.lower, old)).all()
        assert (command <= np.maximum(robot.upper, old)).all()
        # Within reach of where the joint is.
        band = np.where(np.isfinite(measured), robot.max_lead, np.inf), np.nan_to_num(measured)
        lowest, highest = (
            np.clip(band[1] + side * band[0], np.minimum(robot.lower, old), np.maximum(robot.upper, old))
            for side in (-1, 1)
        )
        assert (lowest <= command).all()
        assert (command <= highest).all()

        rounding = 40 * np.spacing(np.max(np.abs([robot.lower, robot.upper, self.start_at])))
        most = robot.max_acceleration * self.dt**2
        within = np.clip(old, lowest, highest)
        step = np.where(within == old, old - older, 0.0)
        gentlest = np.maximum(np.abs(step) - most, 0.0)
        room = np.where(step > 0, highest - within, within - lowest)
        free = braking(gentlest, most) <= room
        assert (np.abs(command - within)[free] <= (robot.max_velocity * self.dt * (1 + 1e-9) + rounding)[free]).all()
        change = command - within - step
        assert (np.abs(change)[free] <= (most * (1 + 1e-9) + rounding)[free]).all()
        self.before = [within, command]
        return command


def braking(step: Vector, change: Vector) -> Vector:
    """The way of a joint [rad] that goes `step` in this tick and `change` less in each that follows; shape (J,)."""
    n = np.floor(step / change)
    return np.asarray((n + 1) * step - change * n * (n + 1) / 2)


limits = st.tuples(st.floats(-4, 3), st.floats(0.1, 6), st.floats(0.2, 20), st.floats(1, 500)).map(
    lambda t: (t[0], t[0] + t[1], t[2], t[3])
)
robots = st.lists(limits, min_size=1, max_size=3).map(lambda rows: make_robot(*rows))
periods = st.sampled_from([2_000_000, 10_000_000, 33_333_333])
wild = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-6, 6), st.floats(-0.1, 0.1))


@st.composite
def streams(draw: st.DrawFn) -> tuple[Robot, int, Vector, list[tuple[str, Any, int]]]:
    robot = draw(robots)
    size = len(robot.joints)
    vector = st.lists(wild, min_size=size, max_size=size).map(np.array)
    tame = st.lists(st.floats(0, 1), min_size=size, max_size=size).map(
        lambda f: robot.lower + np.array(f) * (robot.upper - robot.lower)
    )
    garbage: st.SearchStrategy[Any] = st.sampled_from(
        [
            np.zeros(size + 1),
            np.zeros((size, 1)),
            np.array(["1"] * size),
            np.zeros(size, bool),
            [0.0] * size,
            "no",
            3,
            {},
        ]
    )
    event = st.one_of(
        st.tuples(st.just("command"), vector, st.integers(1, 30)),
        st.tuples(st.just("command"), tame, st.integers(1, 30)),
        st.tuples(st.just("step"), tame, st.integers(1, 30)),
        st.tuples(st.just("push"), tame, st.integers(1, 80)),
        st.tuples(st.just("command"), garbage, st.integers(1, 5)),
        st.tuples(st.just("command"), st.none(), st.integers(1, 30)),
        st.tuples(st.just("blind"), tame, st.integers(1, 5)),
        st.tuples(st.just("estop"), st.none(), st.just(1)),
        st.tuples(st.just("reset"), tame, st.just(1)),
    )
    outside = st.lists(st.floats(-1.5, 1.5), min_size=size, max_size=size).map(
        lambda f: (robot.lower + robot.upper) / 2 + np.array(f) * (robot.upper - robot.lower)
    )
    start = draw(st.one_of(tame, outside))
    return robot, draw(periods), start, draw(st.lists(event, min_size=1, max_size=8))


def wish(kind: str, value: Any, layer: SafetyLayer, robot: Robot, period_ns: int) -> Any:
    """What is asked for in an event of a stream."""
    dt = period_ns / 1e9
    if kind == "step":  # a small move from where the command is
        return layer.current + np.clip(value - layer.current, -0.002, 0.002)
    if kind == "push":  # speed up as fast as allowed, smoothly, towards a side and on into its limit
        side = np.where(value > (robot.lower + robot.upper) / 2, 1, -1)
        velocity = layer.velocity + side * robot.max_acceleration * dt
        return layer.current + np.clip(velocity, -robot.max_velocity, robot.max_velocity) * dt
    return value


@settings(max_examples=40, deadline=None)
@given(streams())
def test_whatever_is_asked_for_the_limits_hold_and_every_intervention_is_counted(
    stream: tuple[Robot, int, Vector, list[tuple[str, Any, int]]],
) -> None:
    robot, period_ns, start, events = stream
    watched = Watched(robot, period_ns)
    watched.start(start)
    size = len(robot.joints)
    expected = np.zeros(size, dtype=int)
    wrong, missing = 0, 0
    for kind, value, repeats in events:
        if kind == "estop":
            watched.layer.estop()
            continue
        if kind == "reset":
            watched.start(value, reset=True)
            assert not watched.layer.estopped
            continue
        for _ in range(repeats):
            desired = wish(kind, value, watched.layer, robot, period_ns)
            measured = np.full(size, np.nan) if kind == "blind" else None
            command = watched.tick(desired, measured)
            if desired is None:
                missing += 1
            elif isinstance(desired, np.ndarray) and desired.shape == (size,) and desired.dtype == np.float64:
                expected += command != desired
            else:
                wrong += 1
    counters = watched.layer.counters()
    assert counters["wrong_length"] == wrong
    assert counters["missing"] == missing
    assert sum(counters[kind] for kind in KINDS) == expected.sum()
    assert list(watched.layer.interventions.values()) == (expected + wrong).tolist()


@settings(max_examples=60, deadline=None)
@given(streams(), st.data())
def test_wherever_the_joints_are_the_command_is_within_reach_of_them(
    stream: tuple[Robot, int, Vector, list[tuple[str, Any, int]]], data: st.DataObject
) -> None:
    """Joints follow at once, lag, are blocked, or are pushed away; the checks are those of `Watched`."""
    robot, period_ns, start, events = stream
    lead = data.draw(st.one_of(st.none(), st.floats(0.01, 2.0)))
    robot = attrs.evolve(robot, joints=tuple(attrs.evolve(joint, max_lead=lead) for joint in robot.joints))
    watched = Watched(robot, period_ns)
    watched.start(start)
    measured = start
    for kind, value, repeats in events:
        share = data.draw(st.sampled_from([0.0, 0.05, 0.3, 1.0]))
        measured = measured + data.draw(st.sampled_from([0.0, 0.0, -1.0, 0.003, 0.7]))
        for _ in range(repeats if kind in {"command", "step", "push"} else 0):
            measured = measured + share * (watched.layer.current - measured)
            watched.tick(wish(kind, value, watched.layer, robot, period_ns), measured)


def test_a_blocked_joint_does_not_wind_up_and_its_release_makes_no_jump() -> None:
    watched = Watched(one_joint(), PERIOD_NS)  # checks velocity and acceleration: here they never yield
    watched.start(ZERO)
    position, leads = 0.0, []
    for index in range(400):
        wanted = min(2.0 * index * 0.01, 1.9)
        free = index < 20 or index >= 200
        position += 0.15 * (watched.before[-1][0] - position) if free else 0.0
        command = watched.tick(np.array([wanted]), np.array([position]))
        leads.append(abs(command[0] - position))
    assert max(leads[:20]) < USABLE
    assert leads[100:200] == [pytest.approx(USABLE)] * 100
    assert command[0] == 1.9
    assert watched.layer.counters()["lead"] > 100


def test_an_ordinary_fast_motion_does_not_meet_the_lead_limit() -> None:
    """A servo that lags by 0.1 s, and whose readings are 20 ms old, at the limits of an SO-101."""
    watched = Watched(make_robot((-2, 2, 3, 40)), PERIOD_NS)
    watched.start(ZERO)
    plan = np.concatenate([rest_to_rest(a, b, 3.0, 40.0, 0.01) for a, b in ((0, 2), (2, -2), (-2, 1))])
    positions = [0.0, 0.0, 0.0]
    for wanted in plan:
        positions.append(positions[-1] + (1 - np.exp(-0.1)) * (watched.before[-1][0] - positions[-1]))
        assert watched.tick(np.array([wanted]), np.array([positions[-3]]))[0] == wanted
    assert set(watched.layer.counters().values()) == {0}


def test_a_joint_that_is_pushed_away_takes_its_command_along() -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    watched.tick(None)
    assert watched.tick(None, np.array([1.5]))[0] == pytest.approx(1.5 - watched.robot.max_lead[0])
    assert watched.layer.at_rest
    assert watched.tick(ZERO, np.array([-2.0]))[0] == pytest.approx(-2.0 + watched.robot.max_lead[0], abs=0.003)


@pytest.mark.parametrize("speed", [0.3, 1.0, 1.8])
def test_a_blocked_joint_that_slides_away_takes_its_command_along_within_the_limits(speed: float) -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    commands, position = [], 0.0
    for index in range(250):
        if 100 <= index < 170:
            position -= speed * watched.dt
        commands.append(watched.tick(np.array([1.9]), np.array([position]))[0])
    assert np.abs(np.diff(commands, 2)).max() <= 20.0 * watched.dt**2 * 1.001
    assert commands[99] == pytest.approx(USABLE)
    assert commands[-1] == pytest.approx(position + USABLE)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_moving_joint_that_is_pushed_away_rests_where_its_lead_ends(side: int) -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    for _ in range(15):
        watched.tick(np.array([1.9]))
    assert watched.layer.velocity[0] > 2.0
    pushed = watched.layer.current + side * 1.5
    lead = watched.robot.max_lead[0]

    for _ in range(10):
        assert watched.tick(None, pushed)[0] == pytest.approx(pushed[0] - side * lead)


def test_readings_that_repeat_do_not_let_the_command_run_away() -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    for _ in range(200):
        command = watched.tick(np.array([2.0]), ZERO)
    assert command[0] == pytest.approx(USABLE)


@settings(max_examples=40, deadline=None)
@given(limits, periods, st.floats(0, 1), st.floats(0, 1))
def test_a_stationary_target_is_reached_exactly_and_never_overshot(
    limit: tuple[float, float, float, float], period_ns: int, start: float, end: float
) -> None:
    robot = make_robot(limit)
    span = robot.upper - robot.lower
    first = np.clip(robot.lower + start * span, robot.lower, robot.upper)
    target = np.clip(robot.lower + end * span, robot.lower, robot.upper)
    watched = Watched(robot, period_ns)
    watched.start(first)
    distance = abs(target - first)[0]
    velocity, acceleration = robot.max_velocity[0], robot.max_acceleration[0]
    # The time-optimal profile, and a few ticks for its being sampled.
    ideal_s = distance / velocity + min(velocity / acceleration, 2 * np.sqrt(distance / acceleration))
    ticks = int(max(ideal_s, 2 * np.sqrt(distance / acceleration)) / watched.dt) + 8
    low, high = min(first[0], target[0]), max(first[0], target[0])
    for _ in range(min(ticks, 4000)):
        command = watched.tick(target)
        assert low <= command[0] <= high
        if watched.layer.at_rest and command[0] == target[0]:
            break
    if ticks <= 4000:
        assert command[0] == target[0]
        np.testing.assert_array_equal(watched.tick(target), target)
        assert watched.layer.at_rest


@settings(max_examples=40, deadline=None)
@given(streams(), st.floats(0, 1))
def test_after_any_stream_a_stop_ends_at_a_target_within_the_stopping_distance(
    stream: tuple[Robot, int, Vector, list[tuple[str, Any, int]]], end: float
) -> None:
    robot, period_ns, start, events = stream
    watched = Watched(robot, period_ns)
    watched.start(start)
    for kind, value, repeats in events:
        if kind in {"command", "step", "push"}:
            for _ in range(repeats):
                watched.tick(wish(kind, value, watched.layer, robot, period_ns))
    target = np.clip(robot.lower + end * (robot.upper - robot.lower), robot.lower, robot.upper)
    watched.tick(target)
    # Where each joint would stop by itself from here: past the target only if there was no room.
    position, step = watched.layer.current, watched.layer.velocity * watched.dt
    braking = np.zeros_like(step)
    change = robot.max_acceleration * watched.dt**2
    remaining = np.abs(step) - change
    while (remaining > 0).any():
        braking += np.maximum(remaining, 0)
        remaining -= change
    rest = position + np.copysign(braking, step)
    slack = 1e-9 + 1e-9 * np.abs(rest)
    # To brake, to go back, and to make up for what was overshot.
    way = np.abs(target - rest) + 2 * robot.max_velocity**2 / robot.max_acceleration
    needed_s = np.max(way / robot.max_velocity + 4 * robot.max_velocity / robot.max_acceleration + 2 * watched.dt)
    ticks = int(needed_s / watched.dt) + 10
    for _ in range(min(ticks, 500)):
        command = watched.tick(target)
        assert (command <= np.maximum(target, np.maximum(rest, position)) + slack).all()
        assert (command >= np.minimum(target, np.minimum(rest, position)) - slack).all()
        if watched.layer.at_rest and (command == target).all():
            break
    assert ticks > 500 or (command == target).all()


@settings(max_examples=40, deadline=None)
@given(streams())
def test_any_motion_within_the_limits_passes_bit_by_bit_and_counts_nothing(
    stream: tuple[Robot, int, Vector, list[tuple[str, Any, int]]],
) -> None:
    robot, period_ns, start, events = stream
    limiting, passing = SafetyLayer(robot, period_ns), SafetyLayer(robot, period_ns)
    start = np.clip(start, robot.lower, robot.upper)
    limiting.activate(start)
    passing.activate(start)
    for kind, value, repeats in events:
        for _ in range(repeats if kind in {"command", "step", "push"} else 0):
            # What one layer gives out is a motion within the limits, often right at them.
            motion = limiting.apply(wish(kind, value, limiting, robot, period_ns), limiting.current)
            np.testing.assert_array_equal(passing.apply(motion, passing.current), motion)
    assert set(passing.counters().values()) == {0}


@pytest.mark.parametrize("ticks", range(1, 70, 3))
@pytest.mark.parametrize("jump", [0.01, 0.05])
def test_a_target_that_jumps_on_while_it_is_approached_is_not_overshot(ticks: int, jump: float) -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    for index in range(150):
        target = 0.2 if index < ticks else 0.2 + jump
        assert watched.tick(np.array([target]))[0] <= target
    assert watched.layer.current[0] == target


def test_a_gentle_way_to_a_target_keeps_its_speed_and_needs_no_intervention() -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    target = np.array([1.0])
    speeds: list[float] = []
    while not speeds or not watched.layer.at_rest:
        command = watched.tick(watched.layer.towards(target, 0.25))
        assert command[0] <= 1.0
        speeds.append(watched.layer.velocity[0])
    assert command[0] == pytest.approx(1.0, abs=1e-9)
    assert max(speeds) == pytest.approx(1.0)
    assert len(speeds) == pytest.approx(105, abs=3)  # 1 s at speed, and speeding up and braking
    assert sum(watched.layer.counters().values()) == 0


@pytest.mark.parametrize("top", [0.3, 1.0, 2.5, 4.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_motion_that_runs_into_a_limit_is_braked_before_it(side: int, top: float) -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    wanted, speed, commands = 0.0, 0.0, []
    while abs(wanted) < 2.5:
        speed = min(speed + 0.2, top)
        wanted += speed * 0.01
        commands.append(side * watched.tick(np.array([side * wanted]))[0])
        if commands[-1] < 1.95 - top**2 / 40:  # braking takes as long at 20 rad/s2
            assert commands[-1] == wanted
    assert commands[-1] == 2.0
    assert np.abs(np.diff(commands, 2)).max() <= 20.0 * watched.dt**2 * 1.001
    assert watched.layer.counters()["acceleration"] > 0
    assert watched.layer.counters()["position"] > 0


def rest_to_rest(start: float, end: float, velocity: float, acceleration: float, dt: float) -> Vector:
    """Cosine ramp whose peak speed and acceleration are at the given values or below, sampled each dt."""
    amplitude = (end - start) / 2
    omega = min(velocity / abs(amplitude), np.sqrt(acceleration / abs(amplitude)))
    time = np.arange(int(np.pi / omega / dt) + 1) * dt
    return np.append(start + amplitude * (1 - np.cos(omega * time)), end)


def test_a_limited_speed_is_kept_and_begins_at_rest() -> None:
    watched = Watched(one_joint(velocity=4.0, acceleration=20.0), PERIOD_NS)
    watched.start(ZERO)
    watched.layer.limit_speed(0.1)
    steps = np.diff([watched.tick(np.array([1.0]))[0] for _ in range(100)])
    assert steps.max() == pytest.approx(0.1 * 4.0 * 0.01, rel=1e-6)
    with pytest.raises(HardwareError, match="the robot moves: wait until it is at rest"):
        watched.layer.limit_speed(0.05)
    watched.layer.limit_speed(1.0)
    assert np.diff([watched.tick(np.array([1.5]))[0] for _ in range(60)]).max() > 0.02


@settings(max_examples=40, deadline=None)
@given(limits, periods, st.floats(0, 1), st.floats(0, 1))
def test_a_plan_at_the_limits_from_rest_to_rest_passes_unchanged(
    limit: tuple[float, float, float, float], period_ns: int, start: float, end: float
) -> None:
    lower, upper, velocity, acceleration = limit
    first, last = np.clip(lower + np.array([start, end]) * (upper - lower), lower, upper)
    if abs(last - first) < 1e-3:
        last = lower if first > (lower + upper) / 2 else upper
    plan = np.clip(rest_to_rest(first, last, velocity, acceleration, period_ns / 1e9), lower, upper)
    watched = Watched(make_robot(limit), period_ns)
    watched.start(plan[:1])
    for wanted in plan[:2000]:
        assert watched.tick(np.array([wanted]))[0] == wanted
    assert set(watched.layer.counters().values()) == {0}


def test_a_smooth_stream_is_caught_up_with_after_a_gap() -> None:
    time = np.arange(400) * 0.01
    plan = 1.5 * np.sin(2.0 * time) * np.minimum(time, 1) ** 2
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    late = []
    for index, wanted in enumerate(plan):
        command = watched.tick(np.array([np.nan if 300 <= index < 303 else wanted]))
        if index > 200 and command[0] != wanted:
            late.append(index)
    assert late[0] == 300
    assert late[-1] < 350


def test_the_kinds_of_intervention_are_distinguished() -> None:
    def counted(desired: Any, *, ticks: int = 1, settle: bool = True, measured: Vector | None = None) -> dict[str, int]:
        watched = Watched(one_joint(), PERIOD_NS)
        watched.start(ZERO)
        if settle:
            watched.tick(ZERO)
        for _ in range(ticks):
            watched.tick(desired, measured)
        return {kind: count for kind, count in watched.layer.counters().items() if count}

    assert counted(np.array([0.5]), settle=False) == {"first_command": 1}
    assert counted(np.array([0.0019]), settle=False) == {}
    assert counted(np.array([np.nan])) == {"nonfinite": 1}
    assert counted(np.array([-np.inf])) == {"nonfinite": 1}
    assert counted(np.array([2.5])) == {"position": 1}
    assert counted(np.array([1.5]), measured=np.array([-1.0])) == {"lead": 1}
    assert counted(np.array([0.5])) == {"velocity": 1}
    assert counted(np.array([0.03])) == {"acceleration": 1}
    assert counted(np.array([0.001]), measured=np.array([np.nan])) == {"unmeasured": 1}
    assert counted(np.zeros(2), ticks=3) == {"wrong_length": 3}
    assert counted([0.0]) == {"wrong_length": 1}
    assert counted(None, ticks=4) == {"missing": 4}


def test_interventions_are_counted_per_joint() -> None:
    layer = SafetyLayer(make_robot((-1, 1, 1, 1), (-1, 1, 1, 1)), PERIOD_NS)
    layer.activate(np.zeros(2))
    layer.apply(np.array([0.0, np.nan]), np.zeros(2))
    assert layer.interventions == {"j0": 0, "j1": 1}
    layer.apply(np.zeros(5), np.zeros(2))
    assert layer.interventions == {"j0": 1, "j1": 2}


def test_a_non_finite_joint_brakes_while_the_others_go_on() -> None:
    watched = Watched(make_robot((-2, 2, 4, 20), (-2, 2, 4, 20)), PERIOD_NS)
    watched.start(np.zeros(2))
    for _ in range(12):
        watched.tick(np.array([1.5, 1.5]))
    speed = watched.layer.velocity[0]
    assert speed > 1
    watched.tick(np.array([np.nan, 1.5]))
    assert watched.layer.velocity[0] == pytest.approx(speed - 0.2)
    assert watched.layer.velocity[1] > speed
    for _ in range(100):
        command = watched.tick(np.array([np.nan, 1.5]))
    assert watched.layer.at_rest
    assert command[0] < command[1] == 1.5


@pytest.mark.parametrize("silence", [None, np.zeros(7), np.array([np.inf])])
def test_silence_and_garbage_brake_at_the_limit_and_hold(silence: Any) -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    for _ in range(10):
        watched.tick(np.array([1.9]))
    ticks = int(np.ceil(watched.layer.velocity[0] / 0.2 - 1e-6))
    for left in range(ticks, 0, -1):
        assert watched.layer.velocity[0] == pytest.approx(0.2 * left)
        watched.tick(silence)
    assert watched.layer.at_rest
    held = watched.layer.current
    np.testing.assert_array_equal(watched.tick(silence), held)


def test_the_emergency_stop_latches_brakes_and_ignores_until_reset() -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(ZERO)
    for _ in range(10):
        watched.tick(np.array([1.9]))
    watched.layer.estop()
    assert watched.layer.estopped
    before = watched.layer.counters()
    for _ in range(30):
        watched.tick(np.array([1.9]))
    assert watched.layer.at_rest
    assert watched.layer.counters() == {**before, "estop": 30}
    watched.layer.activate(watched.layer.current)  # torque returned: still stopped
    assert watched.layer.estopped
    watched.start(np.array([0.3]), reset=True)
    assert not watched.layer.estopped
    assert watched.tick(np.array([0.3005]))[0] == 0.3005


def test_a_reset_at_unknown_positions_is_refused_and_stays_stopped() -> None:
    layer = SafetyLayer(one_joint(), PERIOD_NS)
    layer.activate(ZERO)
    layer.estop()
    with pytest.raises(HardwareError, match="joint j0 is measured at nan"):
        layer.reset(np.array([np.nan]))
    assert layer.estopped


def test_a_joint_outside_its_limits_stays_until_asked_inwards_and_never_goes_back_out() -> None:
    watched = Watched(one_joint(), PERIOD_NS)
    watched.start(np.array([2.3]))
    assert watched.layer.counters()["outside"] == 1
    assert watched.tick(np.array([2.3]))[0] == 2.3  # holding there is no intervention, and no motion nobody asked for
    assert watched.layer.interventions["j0"] == 0
    for _ in range(10):
        watched.tick(np.array([2.1]))
    inside = watched.layer.current[0]
    assert inside < 2.3
    furthest = inside
    for _ in range(50):
        command = watched.tick(np.array([2.3]))[0]
        assert command <= furthest
        furthest = command
    assert watched.layer.counters()["position"] == 50
    for _ in range(200):
        watched.tick(np.array([0.0]))
    for _ in range(200):
        command = watched.tick(np.array([2.3]))[0]
    assert command == 2.0


def test_activation_needs_finite_positions_of_every_joint() -> None:
    layer = SafetyLayer(one_joint(), PERIOD_NS)
    with pytest.raises(RuntimeError, match="activated"):
        layer.apply(ZERO, ZERO)
    with pytest.raises(HardwareError, match="measured at inf"):
        layer.activate(np.array([np.inf]))
    with pytest.raises(HardwareError, match="must be 1 numbers"):
        layer.activate(np.zeros(2))
    with pytest.raises(ValueError, match="period_ns"):
        SafetyLayer(one_joint(), 0)


def test_what_is_given_and_returned_is_the_callers_to_change() -> None:
    layer = SafetyLayer(one_joint(), PERIOD_NS)
    start = np.zeros(1)
    layer.activate(start)
    start[:] = 1.0
    wanted = np.array([0.001])
    layer.apply(wanted, ZERO)[:] = 1.0
    wanted[:] = 1.0
    layer.current[:] = 1.0
    np.testing.assert_array_equal(layer.current, [0.001])
