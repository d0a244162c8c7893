"""Teleop `webxr` by a stepped clock: poses of a hand in, joint positions out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, override

import attrs
import numpy as np
import pytest
from ibrobot_kinematics.rotations import exp, log
from ibrobot_testing import TeleopSuite, host_context
from ibrobot_webxr.hand import HandMotion
from ibrobot_webxr.messages import HandPose, Hands
from ibrobot_webxr.one_euro import PoseFilter, delay
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.teleop import WebxrTeleop

from ibrobot_core.api import Context, Teleop, TeleopCommand, TeleopError

from .rig import ANY_PORT, TICK_S, UPRIGHT, Rig, page_of, robot_of

TURNED_LEFT = (0.0, math.sin(0.05), 0.0, math.cos(0.05))
"""By 0.1 rad about the vertical."""
ROLLED = (0.0, 0.0, math.sin(0.1), math.cos(0.1))
"""By 0.2 rad about the axis towards the operator."""
Start = Callable[..., Rig]


@pytest.fixture
def start(mjcf: Path) -> Iterator[Start]:
    rigs: list[Rig] = []

    def start(**changes: Any) -> Rig:
        options = {name: changes.pop(name) for name in tuple(changes) if name in attrs.fields_dict(WebxrOptions)}
        rigs.append(Rig(mjcf, attrs.evolve(ANY_PORT, **options), **changes))
        return rigs[-1]

    yield start
    for rig in rigs:
        rig.teleop.disconnect()


class TestWebxr(TeleopSuite):
    step_rad = 0.1  # motion goes on from the last setpoint

    mjcf: ClassVar[Path]

    @pytest.fixture(autouse=True)
    def arm(self, mjcf: Path) -> None:
        type(self).mjcf = mjcf
        self.time_s = 0.0

    @override
    def make(self, ctx: Context) -> Teleop:
        self.ctx = ctx
        return WebxrTeleop(ANY_PORT, ctx)

    @override
    def context(self) -> Context:
        return host_context(robot=robot_of(self.mjcf))

    def send(self, clutch: bool, *places: float) -> None:
        with page_of(ANY_PORT, self.ctx) as page:
            for place in places:
                self.time_s += 0.02
                pose = HandPose(UPRIGHT, (0.0, 1.0, place), clutch)
                page.exchange.put(Hands(1, self.time_s, 0.0, {"right": pose}), 0.0)

    @override
    def engage(self, teleop: Teleop) -> None:
        self.send(False, 0.0)
        self.send(True, 0.0)

    @override
    def operate(self, teleop: Teleop) -> None:
        self.send(True, -0.01, -0.02, -0.03)

    @override
    def release(self, teleop: Teleop) -> None:
        self.send(False, -0.03)


def test_the_tool_moves_as_the_hand_does_while_the_clutch_is_held(start: Start):
    rig = start()
    before = rig.tip()
    rig.go((0.0, 0.0, -0.05))
    np.testing.assert_array_equal(rig.tip(), before)
    rig.press()
    rig.go((0.0, 0.0, -0.05))
    np.testing.assert_allclose(rig.tip() - before, [0.05, 0, 0], atol=2e-3)  # forward
    rig.go((-0.03, 0.0, 0.0))
    np.testing.assert_allclose(rig.tip() - before, [0.05, 0.03, 0], atol=2e-3)  # to the left
    rig.go((0.0, 0.04, 0.0))
    np.testing.assert_allclose(rig.tip() - before, [0.05, 0.03, 0.04], atol=3e-3)  # up
    rig.clutch = False
    held = rig.position
    assert rig.tick(3).positions is None
    rig.go((0.0, 0.0, 0.1))
    np.testing.assert_array_equal(rig.position, held)


def test_the_direction_is_that_of_the_operators_view(start: Start):
    rig = start(facing=math.pi, scale=0.5)
    rig.heading = math.pi / 2  # looks to -x
    before = rig.tip()
    rig.press()
    rig.go((-0.06, 0.0, 0.0))  # away from the operator, who faces the robot: towards the robot's base
    np.testing.assert_allclose(rig.tip() - before, [-0.03, 0, 0], atol=2e-3)


def test_the_tool_turns_with_the_hand(start: Start):
    rig = start()
    before = rig.rotation()
    rig.press()
    rig.orientation = ROLLED
    rig.tick(100)
    # The hand turned counterclockwise for the operator: about -x of the robot's base.
    np.testing.assert_allclose(log(rig.rotation() @ before.T), [-0.2, 0, 0], atol=0.01)


def test_without_turning_the_tool_keeps_its_direction(start: Start):
    rig = start(turn=False)
    before = rig.rotation()
    rig.press()
    rig.orientation = ROLLED
    rig.tick(100)
    np.testing.assert_allclose(rig.rotation(), before, atol=1e-6)


def test_engaging_again_moves_less_than_a_milliradian(start: Start):
    rig = start(sag=np.array([0.01, -0.03, 0.02, 0.0, 0.01, -0.02]))
    rng = np.random.default_rng(5)
    rig.press()
    rig.go((0.0, 0.05, -0.05))
    for _ in range(30):
        rig.clutch = False
        rig.tick(5)
        held = rig.position
        rig.at = rng.uniform(-1, 1, 3)
        turn = rng.normal(size=4)
        rig.orientation = tuple((turn / np.linalg.norm(turn)).tolist())
        rig.heading = float(rng.uniform(-3, 3))
        rig.press()
        moved = [np.abs(rig.position - held).max()]
        for _ in range(20):
            rig.tick()
            moved.append(np.abs(rig.position - held).max())
        assert max(moved) < 1e-3


def test_an_arm_that_was_pushed_away_starts_where_it_is(start: Start):
    rig = start()
    rig.press()
    rig.clutch = False
    rig.tick(5)
    rig.position = rig.position + 0.2
    pushed = rig.position
    rig.press()
    np.testing.assert_allclose(rig.position[:5], pushed[:5], atol=1e-9)


def moving(rig: Rig, ticks: int = 20) -> None:
    """Move the hand to the front at 0.2 m/s, with the clutch held."""
    for _ in range(ticks):
        rig.at = rig.at + np.array([0.0, 0.0, -0.2 * TICK_S])
        rig.tick()


def lasts(rig: Rig, ticks: int = 30) -> int:
    """Ticks for which the arm still moves."""
    path = [rig.position]
    for _ in range(ticks):
        rig.at = rig.at + np.array([0.0, 0.0, -0.2 * TICK_S])
        rig.tick()
        path.append(rig.position)
    changed = np.nonzero(np.abs(np.diff(path, axis=0)).max(axis=1) > 1e-9)[0]
    return int(changed[-1]) + 1 if changed.size else 0


def test_a_network_that_is_gone_holds_within_a_tenth_of_a_second(start: Start):
    rig = start()
    rig.press()
    moving(rig)
    rig.connected = False
    assert 0 < lasts(rig) * TICK_S < 0.1
    assert rig.last.positions is None


def test_without_tracking_the_arm_brakes_within_the_limits_and_does_not_return(start: Start):
    rig = start()
    rig.press()
    moving(rig)
    path = [rig.position]
    rig.tracked = False
    for _ in range(12):
        rig.tick()
        path.append(rig.position)
    steps = np.diff(path, axis=0)
    assert np.abs(steps[2]).max() > 0, "it does not stop at once"
    assert not steps[8:].any()
    assert (steps * steps[0] >= 0).all()
    assert np.abs(np.diff(steps, axis=0)).max() < 40.0 * TICK_S**2
    assert rig.last.positions is None


def test_late_poses_hold_and_a_burst_of_them_moves_nothing(start: Start):
    rig = start()
    rig.press()
    moving(rig)
    rig.connected = False
    rig.tick(10)
    held = rig.position
    for _ in range(20):
        rig.at = rig.at + 0.01
        rig.send(late_s=0.3)
    rig.tick(3)
    np.testing.assert_array_equal(rig.position, held)


@pytest.mark.parametrize("lost_s", [0.15, 0.6])
@pytest.mark.parametrize("how", ["connected", "tracked"])
def test_after_a_loss_the_clutch_must_be_pressed_again(start: Start, how: str, lost_s: float):
    rig = start()
    rig.press()
    moving(rig)
    setattr(rig, how, False)
    rig.tick(round(lost_s / TICK_S))
    setattr(rig, how, True)
    held = rig.position
    rig.at = rig.at + np.array([0.1, 0.05, 0.2])
    rig.tick(30)
    assert rig.last.positions is None
    np.testing.assert_array_equal(rig.position, held)
    assert rig.page.exchange.reports()["right"].text == "release the clutch and press it again"
    assert rig.press().positions is not None


def test_a_clutch_held_before_the_mode_begins_counts_as_released(start: Start):
    rig = start()
    rig.clutch = True
    rig.tick(20)
    assert rig.last.positions is None
    rig.press()
    assert rig.last.positions is not None
    rig.teleop.begin_operation(rig.measured())
    assert rig.tick(20).positions is None


def test_a_jump_of_the_tracking_moves_nothing(start: Start):
    rig = start()
    rig.press()
    rig.go((0.0, 0.0, -0.03))
    before = rig.position
    rig.at = rig.at + np.array([0.3, 0.2, 0.0])  # e.g. a phone recognises its room again
    rig.orientation = TURNED_LEFT
    rig.tick(50)
    np.testing.assert_allclose(rig.position, before, atol=1e-3)
    tip = rig.tip()
    rig.go((0.0, 0.03, 0.0))
    np.testing.assert_allclose(rig.tip() - tip, [0, 0, 0.03], atol=3e-3)


def test_a_hand_beyond_the_reach_slips_and_moves_the_tool_soon_when_it_returns(start: Start):
    rig = start()
    rig.press()
    rig.go((0.0, 0.0, -0.6), 2.0)
    far = rig.tip()
    rig.go((0.0, 0.0, 0.15), 0.5)
    assert far[0] - rig.tip()[0] > 0.03


def test_nothing_goes_faster_than_the_limits(start: Start):
    rig = start(tool_speed=0.2)
    rig.press()
    tips = []
    for i in range(100):
        rig.at = rig.at + np.array([0.0, 0.004 * math.cos(i / 8), -0.004 * math.sin(i / 8)])
        rig.tick()
        tips.append(rig.tip())
    speeds = np.linalg.norm(np.diff(tips, axis=0), axis=1) / TICK_S
    assert 0.1 < speeds.max() < 0.21


def test_a_phone_at_rest_leaves_the_arm_at_rest_for_ten_minutes(mjcf: Path):
    motion = HandMotion(WebxrOptions())
    rng = np.random.default_rng(11)
    motion.engage(HandPose(UPRIGHT, (0.0, 1.0, 0.0), True), 0.3, 0.0)
    rate, most = 10, 0.0
    noise = rng.normal(scale=0.00015, size=(600 * rate, 3))
    for i in range(1, 600 * rate):
        t = i / rate
        half = (2e-3 * t + 5e-4 * math.sin(9 * t)) / 2  # 1.2 rad of drift about the vertical
        place = np.array([0.0002 * t, 1.0, 0.0]) + noise[i]  # 12 cm of drift
        orientation = (0.0, math.sin(half), 0.0, math.cos(half))
        motion.update(HandPose(orientation, tuple(place.tolist()), True), t)
        most = max(most, abs(motion.moved).max(), abs(log(motion.turned)).max())
    assert most < 1e-9


def test_a_hand_that_leaves_its_rest_moves_without_a_step(start: Start):
    rig = start()
    rig.press()
    rig.tick(100)
    path = [rig.tip()]
    for _ in range(100):
        rig.at = rig.at + np.array([0.0, 0.0, -0.0003])
        rig.tick()
        path.append(rig.tip())
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert np.sum(steps) == pytest.approx(0.03, abs=0.004)
    assert steps.max() < 0.0006


@pytest.mark.parametrize("speed", [0.05, 0.5])
def test_the_delay_of_the_filter_is_the_documented_one(speed: float):
    options = WebxrOptions()
    one_euro = PoseFilter(options.cutoff, options.cutoff_slope)
    place = np.zeros(3)
    for _ in range(400):
        place = place + np.array([speed / 60, 0.0, 0.0])
        one_euro.update(place, np.eye(3), 1 / 60)
    lag_s = (place - one_euro.position)[0] / speed
    assert lag_s == pytest.approx(delay(options.cutoff + options.cutoff_slope * speed), rel=0.02)


def test_the_filter_turns_by_the_shortest_way():
    one_euro = PoseFilter(4.0, 20.0)
    for i in range(200):
        one_euro.update(np.zeros(3), exp(np.array([0.0, 0.0, 0.01 * i])), 1 / 60)
    assert log(one_euro.rotation)[2] == pytest.approx(1.99, abs=0.02)


def test_the_trigger_closes_the_gripper_once_it_moves(start: Start):
    rig = start(trigger=0.0)
    rig.press()
    opened = rig.position[5]
    rig.tick(30)
    assert rig.position[5] == opened, "a trigger at rest leaves the gripper where it is"
    rig.trigger = 1.0
    rig.tick(10)
    assert opened - rig.position[5] == pytest.approx(0.2, abs=0.05)
    rig.tick(200)
    assert rig.position[5] == pytest.approx(-2.4)
    rig.clutch = False
    rig.tick(5)
    rig.trigger = 0.0
    rig.press()
    rig.tick(30)
    assert rig.position[5] == pytest.approx(-2.4), "an object in the gripper stays there"
    rig.trigger = 0.5
    rig.tick(200)
    assert rig.position[5] == pytest.approx(0.0, abs=0.01)


def test_an_object_in_the_gripper_is_still_squeezed_after_engaging_again(start: Start):
    rig = start(trigger=1.0)
    rig.press()
    rig.sag = np.array([0, 0, 0, 0, 0, 0.3])  # an object holds the gripper open
    held = rig.position[5]
    rig.press()
    assert rig.position[5] == held


def test_buttons_move_the_gripper_and_sticks_the_tool(start: Start):
    rig = start(has_position=False)
    rig.open = 1.0
    rig.tick(20)
    assert rig.last.positions is None
    rig.press()
    before, tip = rig.position, rig.tip()
    rig.tick(20)
    assert rig.position[5] - before[5] > 0.3
    rig.open, rig.move = 0.0, (0.0, 0.0, -1.0)
    rig.tick(50)
    rig.move = (0.0, 0.0, 0.0)
    rig.tick(30)
    np.testing.assert_allclose(rig.tip() - tip, [0.05, 0, 0], atol=4e-3)


def test_one_hand_at_once_moves_an_arm_that_takes_any(start: Start):
    rig = start(side="left")
    rig.press()
    left = rig.hands()["left"]
    page = rig.page
    for i in range(20):
        both = {"left": left, "right": attrs.evolve(left, position=(0.0, 0.0, -0.01 * i), clutch=i > 2)}
        rig.connected = False
        page.exchange.put(Hands(1, rig.ctx.clock.now_ns() * 1e-9, 0.0, both), 0.0)
        before = rig.position
        assert rig.tick().positions is not None
        np.testing.assert_allclose(rig.position, before, atol=1e-9)


def test_two_devices_share_one_page_and_take_a_hand_each(mjcf: Path):
    ctx = host_context("left_hand", robot=robot_of(mjcf))
    left = WebxrTeleop(attrs.evolve(ANY_PORT, hand="left"), ctx)
    right = WebxrTeleop(attrs.evolve(ANY_PORT, hand="right"), attrs.evolve(ctx, name="right_hand"))
    left.connect()
    right.connect()
    try:
        with page_of(ANY_PORT, ctx) as page:
            clash = WebxrTeleop(attrs.evolve(ANY_PORT, image_rate=5.0), attrs.evolve(ctx, name="clash"))
            with pytest.raises(TeleopError, match=r"clash: shares the page on port 0 with left_hand.*same image_rate"):
                clash.connect()
            assert left.help() == right.help()
            assert page.address in left.help()
    finally:
        left.disconnect()
        right.disconnect()


def test_buttons_and_the_stop_of_the_page_reach_the_run_once(start: Start):
    rig = start()
    rig.press()
    exchange = rig.page.exchange
    exchange.press("start")
    exchange.press("success")
    assert rig.tick().events == ("start", "success")
    assert rig.tick().events == ()
    exchange.stop()
    command = rig.tick()
    assert command.estop
    assert command.positions is None
    assert not rig.tick(10).estop
    assert rig.last.positions is None, "a clutch held during the stop counts as released"


def test_a_robot_without_a_model_is_refused(mjcf: Path):
    teleop = WebxrTeleop(ANY_PORT, host_context("hand"))
    with pytest.raises(TeleopError, match=r"hand: a hand moves the tool, which needs robot\.description\.mjcf"):
        teleop.connect()
    robot = robot_of(mjcf)
    robot = attrs.evolve(robot, description=attrs.evolve(robot.description, tip="tol"))
    teleop = WebxrTeleop(ANY_PORT, host_context("hand", robot=robot))
    with pytest.raises(TeleopError, match=r"has no site 'tol'; it has: tool"):
        teleop.connect()


def test_positions_that_are_not_finite_hold(start: Start):
    rig = start()
    rig.press()
    rig.sag = np.full(6, np.nan)
    assert rig.tick().positions is None
    assert isinstance(rig.last, TeleopCommand)
