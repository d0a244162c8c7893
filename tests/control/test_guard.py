"""A guard chooses between the command of the limits and braking; whatever it returns, the limits hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.api import Descriptor, Joint, Robot
from ibrobot_core.control.commands import BeginStartup, ClearFaults
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces import Executor, Guard
from ibrobot_core.interfaces.hardware import Condition, Severity
from ibrobot_core.plugins import Entry

PERIOD_S = 0.01
ROBOT = Robot(
    name="two",
    joints=tuple(Joint(name, -1.0, 1.5, max_velocity=3.0, max_acceleration=40.0) for name in "ab"),
    groups={"arm": ("a", "b")},
)


HOT = Condition("lift", "temperature", 58.0, "deg C", Severity.WARNING, "lift is hot", True)
LABEL = '{"first": "x", "second": "y", "distance": 0.01, "text": "x was 10.0 mm from y"}'


class Says(Guard):
    """A guard that returns what a function makes of the setpoint."""

    def __init__(self, say: Callable[[np.ndarray], Any]) -> None:
        self.say = say
        self.seen: list[tuple[np.ndarray, ...]] = []
        self.overruled = LABEL

    def accept(self, position, velocity, setpoint, measured):
        self.seen.append((position, velocity, setpoint, measured))
        return self.say(setpoint)

    def world(self, change) -> None:
        raise NotImplementedError


ANYTHING = st.one_of(
    st.lists(st.floats(), min_size=2, max_size=2).map(np.array), st.none(), st.just(np.zeros(3)), st.just("no"),
    st.lists(st.floats(-3, 3), min_size=2, max_size=2).map(np.array),
)  # fmt: skip


@given(st.lists(st.tuples(ANYTHING, st.lists(st.floats(-3, 3), min_size=2, max_size=2)), min_size=1, max_size=30))
def test_limits_hold_whatever_a_guard_returns(ticks) -> None:
    answers = iter([answer for answer, _ in ticks])
    layer = SafetyLayer(ROBOT, 10_000_000, Says(lambda setpoint: next(answers)))
    at, step = np.zeros(2), np.zeros(2)
    layer.activate(at)
    for _, wanted in ticks:
        command = layer.apply(np.array(wanted), at)
        assert np.isfinite(command).all()
        assert ((command >= -1.0) & (command <= 1.5)).all()
        assert (np.abs(command - at) <= 3.0 * PERIOD_S + 1e-9).all()
        assert (np.abs((command - at) - step) <= 40.0 * PERIOD_S**2 + 1e-9).all()
        at, step = command, command - at
    for _ in range(12):
        at = layer.apply(None, at)
    assert layer.at_rest
    assert ((at >= -1.0) & (at <= 1.5)).all()


def test_a_guard_that_refuses_brakes_the_joints_and_counts() -> None:
    guard = Says(lambda setpoint: setpoint)
    layer = SafetyLayer(ROBOT, 10_000_000, guard)
    layer.activate(np.zeros(2))
    wanted = np.array([1.0, 0.0])
    for _ in range(20):
        at = layer.apply(wanted, layer.current)
    guard.say = lambda setpoint: np.full(2, math.nan)
    rest = layer.rest
    for _ in range(20):
        at = layer.apply(wanted, at)
    assert at == pytest.approx(rest, abs=1e-9)
    assert layer.overruled == guard.overruled
    assert layer.counters()["guard"] == 20
    assert layer.interventions["a"] >= 20


def test_a_guard_sees_the_command_that_the_limits_permit() -> None:
    guard = Says(lambda setpoint: setpoint)
    layer, alone = SafetyLayer(ROBOT, 10_000_000, guard), SafetyLayer(ROBOT, 10_000_000)
    for each in (layer, alone):
        each.activate(np.zeros(2))
    at = np.zeros(2)
    for wanted in np.random.default_rng(0).uniform(-2, 2, (50, 2)):
        measured = at + 0.001
        before, speed = layer.current, layer.velocity
        at = layer.apply(wanted, measured)
        assert at.tobytes() == alone.apply(wanted, measured).tobytes()
        for seen, given_ in zip(guard.seen[-1], (before, speed, at, measured), strict=True):
            assert seen == pytest.approx(given_)


@pytest.mark.parametrize("brake", [lambda layer: layer.apply(None, layer.current), lambda layer: layer.estop()])
def test_braking_asks_no_guard(brake) -> None:
    guard = Says(lambda setpoint: setpoint)
    layer = SafetyLayer(ROBOT, 10_000_000, guard)
    layer.activate(np.zeros(2))
    brake(layer)
    layer.apply(None, np.zeros(2))
    assert guard.seen == []
    assert layer.overruled == ""


class Broken(Exception):
    """What a plugin's bug may raise."""


@pytest.mark.parametrize("error", [ValueError("nothing near"), ZeroDivisionError(), IndexError("5"), Broken("x")])
def test_an_error_of_a_guard_brakes_and_lets_no_command_through(error: Exception) -> None:
    guard = Says(lambda setpoint: setpoint)
    layer = SafetyLayer(ROBOT, 10_000_000, guard)
    layer.activate(np.zeros(2))
    for _ in range(20):
        at = layer.apply(np.array([1.0, 0.0]), layer.current)
    rest = layer.rest

    def fail(setpoint: np.ndarray) -> None:
        raise error

    guard.say = fail
    for _ in range(20):
        at = layer.apply(np.array([1.0, 0.0]), at)
        assert layer.guard_fault == f"control.guard fails: {type(error).__name__}: {error}"
    assert at == pytest.approx(rest, abs=1e-9)
    guard.say = lambda setpoint: setpoint
    assert layer.apply(at, at) == pytest.approx(at)
    assert layer.guard_fault == ""


class TestInControl:
    """A control core with a guard."""

    @pytest.fixture
    def rig(self, make_rig):
        self.guard = Says(lambda setpoint: setpoint)
        self.guard.overruled = ""
        entry = Entry("guard", Descriptor("says", lambda options, ctx: self.guard, "says"), "fake", "fake", "1.0")
        return make_rig({"control": {"guard": {"type": "says"}}}, entries=[entry])

    def test_an_error_of_the_guard_is_a_fault_that_holds_until_a_reset(self, rig) -> None:
        rig.start()
        rig.plan([0.8, 0.8, 0.8])
        rig.tick(20)

        def fail(setpoint: np.ndarray) -> None:
            raise KeyError("wall")

        self.guard.say = fail
        rig.tick(30)
        assert rig.core.fault == "control.guard fails: KeyError: 'wall'"
        at = rig.tick().command
        np.testing.assert_array_equal(rig.tick(10).command, at)
        assert at[0] < 0.5
        rig.assert_within_limits()
        self.guard.say = lambda setpoint: setpoint
        rig.call(ClearFaults())
        rig.plan([0.5, 0.5, 0.5])
        assert rig.tick(80).command == pytest.approx(0.5)

    def test_executors_of_changed_joints_learn_what_held_them_back(self, rig, monkeypatch) -> None:
        noted = []
        monkeypatch.setattr(Executor, "note_guard", lambda self, overruled: noted.append((self.joints, overruled)))
        rig.start()
        rig.plan([0.8, 0.8, 0.8])
        rig.tick(5)
        assert noted == []
        self.guard.overruled = LABEL
        at = rig.core.state.command
        self.guard.say = lambda setpoint: np.array([at[0], at[1], setpoint[2]])
        rig.tick()
        assert noted == [(("pan", "lift"), LABEL)]

    def test_its_counts_are_a_group_of_their_own(self, rig) -> None:
        self.guard.counts = {"ticks": 3, "pairs": 302}
        rig.start()
        counters = rig.core.counters()
        assert counters["guard"] == {"ticks": 3, "pairs": 302}
        assert not {"guard_pairs", "pairs", "ticks"} & counters["safety"].keys(), "evaluations add these up"


POSES: dict[str, dict[str, Any]] = {
    "control.startup": {"startup": "pose rest"},
    "control.stop": {"stop": "pose rest"},
    "control.load_shedding": {"load_shedding": {"after": 0.1, "pose": "rest"}},
}


@pytest.mark.parametrize("key", POSES)
def test_motions_to_poses_of_the_robot_yaml_are_guarded(make_rig, key: str) -> None:
    """The guard lets pan go no further than -0.3; the pose `rest` has it at -0.8."""
    guard = Says(lambda setpoint: np.maximum(setpoint, [-0.3, -9.0, -9.0]))
    entry = Entry("guard", Descriptor("says", lambda options, ctx: guard, "says"), "fake", "fake", "1.0")
    rig = make_rig({"control": {"guard": {"type": "says"}, **POSES[key]}}, entries=[entry])
    if key == "control.startup":
        rig.core.start("stream")
        rig.call(BeginStartup())
    else:
        rig.start()
    if key == "control.stop":
        rig.core.begin_stop()
    if key == "control.load_shedding":
        rig.hardware.conditions = (HOT,)
    rig.tick(300)
    pan, lift, _ = np.array(rig.hardware.written).T
    assert pan.min() == pytest.approx(-0.3, abs=0.01), "braking included"
    assert lift.max() > 0.9


def test_a_start_that_the_guard_holds_back_says_from_what(make_rig) -> None:
    guard = Says(lambda setpoint: np.maximum(setpoint, [-0.3, -9.0, -9.0]))
    entry = Entry("guard", Descriptor("says", lambda options, ctx: guard, "says"), "fake", "fake", "1.0")
    rig = make_rig({"control": {"guard": {"type": "says"}, "startup": "pose rest"}}, entries=[entry])
    rig.core.start("stream")
    rig.call(BeginStartup())
    rig.tick(1100)
    with pytest.raises(HardwareError, match=r"pan is 0\.50 rad away; the guard held it: x was 10\.0 mm from y$"):
        rig.core.arrived()
