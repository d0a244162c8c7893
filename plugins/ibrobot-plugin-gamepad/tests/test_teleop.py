"""A pad in an operator's hands: reports in, joint positions out, by the clock of the measurements."""

from __future__ import annotations

import logging
import random
from typing import override

import attrs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ibrobot_gamepad import ibrobot_teleop
from ibrobot_gamepad.mapping import events
from ibrobot_gamepad.options import GamepadOptions, SpaceMouseOptions
from ibrobot_gamepad.teleop import JogTeleop
from ibrobot_testing import TeleopSuite, host_context, make_robot

from ibrobot_core.api import Context, JointReading, OperatorEvent, Robot, Teleop, TeleopCommand, TeleopError, ns

from .fake_hid import DUALSENSE, SPACEMOUSE, FakeHidapi, Plugged, dualsense, mouse_buttons, spacemouse

TICK_S = 0.01
JOINTS = GamepadOptions(cartesian=False, via="hid")
MIDDLE = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
LB = "left_shoulder"


class TestGamepad(TeleopSuite):
    @pytest.fixture(autouse=True)
    def pad(self, hidapi: FakeHidapi) -> None:
        self.device = hidapi.plug(Plugged(*DUALSENSE))

    @override
    def make(self, ctx: Context) -> Teleop:
        return JogTeleop(JOINTS, ctx)

    @override
    def context(self) -> Context:
        self.device.send(dualsense())
        return host_context()

    @override
    def engage(self, teleop: Teleop) -> None:
        self.device.send(dualsense(), dualsense(LB))

    @override
    def operate(self, teleop: Teleop) -> None:
        self.device.send(dualsense(LB, left=(1, 0)))

    @override
    def release(self, teleop: Teleop) -> None:
        self.device.send(dualsense())

    events = events(JOINTS)

    @override
    def press(self, teleop: Teleop, event: OperatorEvent) -> None:
        self.device.send(dualsense(EVENTS[event]), dualsense())


class TestSpaceMouse(TeleopSuite):
    @pytest.fixture(autouse=True)
    def mouse(self, hidapi: FakeHidapi) -> None:
        self.device = hidapi.plug(Plugged(*SPACEMOUSE, usage=0x08))

    @override
    def make(self, ctx: Context) -> Teleop:
        return JogTeleop(SpaceMouseOptions(cartesian=False, start="joints"), ctx)

    @override
    def context(self) -> Context:
        self.device.send(mouse_buttons())
        return host_context()

    @override
    def engage(self, teleop: Teleop) -> None:
        self.device.send(mouse_buttons(), mouse_buttons(0))

    @override
    def operate(self, teleop: Teleop) -> None:
        self.device.send(spacemouse(yaw=1))

    @override
    def hold(self, teleop: Teleop) -> None:
        self.device.send(mouse_buttons(0), spacemouse(yaw=1))

    @override
    def release(self, teleop: Teleop) -> None:
        self.device.send(mouse_buttons())


@attrs.define
class Rig:
    """An operator with a pad, and a robot that goes where it should, unless it is `blocked`."""

    hidapi: FakeHidapi
    options: GamepadOptions | SpaceMouseOptions = JOINTS
    robot: Robot = attrs.field(factory=make_robot)
    position: np.ndarray = attrs.field(factory=MIDDLE.copy)
    time_s: float = 1000.0
    blocked: bool = False
    pad: Plugged = attrs.field(factory=lambda: Plugged(*DUALSENSE))
    teleop: JogTeleop = attrs.field(init=False)

    def __attrs_post_init__(self) -> None:
        self.hidapi.plug(self.pad)
        self.pad.send(dualsense())
        self.teleop = JogTeleop(self.options, host_context("pad", robot=self.robot))
        self.teleop.connect()
        self.teleop.begin_operation(self.measured())

    def measured(self) -> JointReading:
        return JointReading(ns(self.time_s), self.position.copy(), np.zeros(6), np.zeros(6))

    def tick(self, *reports: bytes) -> TeleopCommand:
        if self.pad.present:
            self.pad.send(*reports)
        self.time_s += TICK_S
        command = self.teleop.operate(self.measured())
        if command.positions is not None and not self.blocked:
            self.position = self.setpoint(command)
        return command

    def setpoint(self, command: TeleopCommand) -> np.ndarray:
        assert command.positions is not None
        return np.array([command.positions[name] for name in self.robot.joint_names])

    def hold(self, seconds: float, report: bytes) -> TeleopCommand:
        for _ in range(round(seconds / TICK_S)):
            command = self.tick(report)
        return command

    def engage(self) -> None:
        self.tick(dualsense())
        assert self.tick(dualsense(LB)).positions is not None

    def moved(self) -> dict[str, float]:
        way = self.position - MIDDLE
        return {name: way[i] for i, name in enumerate(self.robot.joint_names) if abs(way[i]) > 1e-9}


@pytest.fixture
def rig(hidapi: FakeHidapi) -> Rig:
    return Rig(hidapi)


STICKS = {
    "shoulder_pan": {"left": (1, 0)},
    "shoulder_lift": {"left": (0, 1)},
    "elbow_flex": {"right": (0, 1)},
    "wrist_flex": {"hat": (0, 1)},
    "wrist_roll": {"right": (1, 0)},
}


@pytest.mark.parametrize(("joint", "controls"), STICKS.items(), ids=STICKS)
def test_each_stick_moves_its_joint_at_joint_speed(rig: Rig, joint: str, controls: dict[str, tuple[int, int]]):
    rig.engage()
    rig.hold(0.5, dualsense(LB, **controls))
    assert rig.moved() == pytest.approx({joint: 0.8 * 0.5})


def test_nothing_moves_without_the_deadman(rig: Rig):
    for _ in range(20):
        assert rig.tick(dualsense(left=(1, 1), right=(1, 1), triggers=(1, 1))) == TeleopCommand(None)


def test_what_is_held_when_the_mode_begins_counts_as_released(rig: Rig):
    rig.engage()
    rig.pad.send(dualsense(LB, left=(1, 0)))
    rig.teleop.begin_operation(rig.measured())
    for _ in range(20):
        assert rig.tick(dualsense(LB, left=(1, 0))).positions is None
    rig.engage()


def test_what_is_held_when_the_pad_comes_counts_as_released(hidapi: FakeHidapi):
    rig = Rig(hidapi)
    hidapi.unplug(rig.pad)
    assert rig.tick().positions is None
    hidapi.plug(rig.pad)
    for _ in range(100):
        assert rig.tick(dualsense(LB, left=(1, 0))).positions is None
    rig.engage()


def test_dead_zone_rescales_the_rest_of_the_way(rig: Rig):
    rig.engage()
    rig.hold(0.5, dualsense(LB, left=(0.09, 0)))
    assert rig.moved() == {}
    rig.hold(0.5, dualsense(LB, left=(0.55, 0)))
    assert rig.moved()["shoulder_pan"] == pytest.approx(0.5 * 0.8 * 0.5, rel=0.01)


def test_triggers_move_the_gripper_once_they_have_moved(hidapi: FakeHidapi):
    rig = Rig(hidapi)
    hidapi.unplug(rig.pad)
    rig.tick()
    hidapi.plug(rig.pad)
    half = (0.5, 0)  # as a pad that does not know its triggers yet may say
    rig.tick(dualsense(triggers=half))
    rig.time_s += 1
    for _ in range(15):
        rig.tick(dualsense(triggers=half))
    rig.tick(dualsense(LB, triggers=half))
    rig.hold(0.3, dualsense(LB, triggers=half))
    assert rig.moved() == {}
    rig.hold(0.1, dualsense(LB))
    rig.hold(0.2, dualsense(LB, triggers=(1, 0)))
    assert rig.moved() == pytest.approx({"gripper": 1.5 * 0.2})
    rig.hold(0.2, dualsense(LB, triggers=(0, 1)))
    assert rig.moved() == {}


def test_home_and_preset_are_approached_at_joint_speed_while_their_buttons_are_held(rig: Rig):
    rig.engage()
    rig.hold(0.25, dualsense(LB, "west"))
    np.testing.assert_allclose(rig.position, MIDDLE * (1 - 0.8 * 0.25 / 0.6))
    stopped = rig.position.copy()
    rig.hold(0.2, dualsense(LB))
    np.testing.assert_array_equal(rig.position, stopped)
    rig.hold(2, dualsense(LB, "west"))
    np.testing.assert_array_equal(rig.position, np.zeros(6))
    rig.hold(4, dualsense(LB, "north"))
    np.testing.assert_allclose(rig.position, rig.robot.pose("rest"))


def test_a_blocked_joint_leads_no_further_than_it_may_and_reverses_at_once(rig: Rig):
    rig.engage()
    rig.blocked = True
    command = rig.hold(2, dualsense(LB, left=(1, 0)))
    assert rig.setpoint(command)[0] - rig.position[0] == pytest.approx(rig.robot.max_lead[0])
    command = rig.tick(dualsense(LB, left=(-1, 0)))
    assert rig.setpoint(command)[0] == pytest.approx(rig.position[0] - 0.8 * TICK_S)


def test_joints_at_rest_follow_the_measured_position(rig: Rig):
    rig.engage()
    rig.blocked = True
    rig.position[2] += 0.7
    assert rig.setpoint(rig.tick(dualsense(LB)))[2] == pytest.approx(rig.position[2] - 0.1)


def test_no_joint_leaves_its_limits(rig: Rig):
    rig.engage()
    rig.hold(8, dualsense(LB, left=(1, 1), right=(1, 1), hat=(0, 1), triggers=(1, 0)))
    np.testing.assert_allclose(rig.position, rig.robot.upper)


def test_a_host_that_stood_still_makes_no_leap(rig: Rig):
    rig.engage()
    rig.tick(dualsense(LB, left=(1, 0)))
    before = rig.position[0]
    rig.time_s += 5
    rig.tick(dualsense(LB, left=(1, 0)))
    assert rig.position[0] - before <= 0.8 * 0.1 + 1e-12


def test_the_stop_button_needs_no_deadman_and_releases_it(rig: Rig):
    assert rig.tick(dualsense("east")) == TeleopCommand(None, estop=True)
    assert rig.tick(dualsense("east")) == TeleopCommand(None), "each press stops once"
    rig.engage()
    assert rig.tick(dualsense(LB, "east", left=(1, 0))).estop
    assert rig.tick(dualsense(LB, left=(1, 0))).positions is None


def test_a_stop_pressed_while_the_mode_begins_is_not_lost(rig: Rig):
    rig.pad.send(dualsense("east"), dualsense())
    rig.teleop.begin_operation(rig.measured())
    assert rig.tick().estop


EVENTS = {
    "start": "start",
    "success": "south",
    "failure": "right_stick",
    "discard": "back",
    "intervention": "left_stick",
}


@pytest.mark.parametrize(("event", "button"), EVENTS.items(), ids=EVENTS)
def test_buttons_ask_for_episodes_and_takeover_once_a_press(rig: Rig, event: str, button: str):
    assert rig.tick(dualsense(button)).events == (event,)
    assert rig.tick(dualsense(button)).events == ()
    assert rig.tick(dualsense(), dualsense(button), dualsense()).events == (event,), "shorter than a tick"


def test_buttons_can_be_given_other_functions(hidapi: FakeHidapi):
    options = GamepadOptions(
        cartesian=False,
        via="hid",
        joints={"shoulder_pan": "-right_y", "elbow_flex": "none"},
        buttons={"deadman": "right_trigger", "gripper_close": "none", "estop": "guide"},
        poses={"rest": "east"},
    )
    rig = Rig(hidapi, options)
    held = (0.0, 1.0)
    rig.tick(dualsense())
    rig.tick(dualsense(triggers=held))
    rig.hold(0.5, dualsense(triggers=held, right=(0, 1)))
    assert rig.moved() == pytest.approx({"shoulder_pan": -0.8 * 0.5})
    assert rig.tick(dualsense("guide")).estop


def test_a_long_press_needs_a_tool(rig: Rig):
    rig.engage()
    rig.hold(1, dualsense(LB, "right_shoulder"))
    rig.hold(0.1, dualsense(LB, left=(1, 0)))
    assert rig.moved() == pytest.approx({"shoulder_pan": 0.08}), "there is no tool mode without a model"


@pytest.mark.parametrize("seed", range(20))
def test_a_pad_unplugged_in_motion_holds_until_the_deadman_is_pressed_again(
    hidapi: FakeHidapi, seed: int, caplog: pytest.LogCaptureFixture
):
    rng = random.Random(seed)
    rig = Rig(hidapi)
    caplog.set_level(logging.INFO)
    moving = dualsense(LB, left=(1, 0))
    rig.engage()
    rig.hold(rng.uniform(0.05, 0.5), moving)
    hidapi.unplug(rig.pad)
    before = rig.position.copy()
    for _ in range(rng.randrange(1, 120)):
        assert rig.tick() == TeleopCommand(None)
    assert "lost Pad (054c:0ce6, DualSense) (read error); the robot holds" in caplog.text
    hidapi.plug(rig.pad)
    for _ in range(100):
        assert rig.tick(moving) == TeleopCommand(None), "the deadman was not pressed again"
    assert rig.pad.opened == 1
    rig.engage()
    np.testing.assert_array_equal(rig.position, before)
    rig.hold(0.1, moving)
    assert rig.position[0] - before[0] == pytest.approx(0.08)


def test_a_pad_out_of_reach_holds(rig: Rig):
    rig.engage()
    silent = [rig.tick().positions is None for _ in range(60)]
    assert silent.index(True) * TICK_S == pytest.approx(0.15, abs=0.02)
    assert all(silent[silent.index(True) :])


XBOX = (0x045E, 0x0B13)


def xbox(*, deadman: bool, right: float = 0.0) -> bytes:
    """A report of an Xbox pad on Bluetooth: the left shoulder, and the left stick to the right."""
    left_x = round(32768 + 32767 * right).to_bytes(2, "little")
    return b"\x01" + left_x + bytes.fromhex("0080" * 3 + "0000" * 2 + "00") + bytes([0x40 if deadman else 0, 0, 0])


def test_a_pad_that_sends_only_changes_is_held_at_rest(hidapi: FakeHidapi):
    rig = Rig(hidapi, pad=Plugged(*XBOX))
    rig.tick(xbox(deadman=False))
    rig.tick(xbox(deadman=True))
    assert all(rig.tick().positions is not None for _ in range(190))
    rig.tick(xbox(deadman=True, right=1))
    rig.tick(xbox(deadman=True, right=0.9))
    assert rig.moved()["shoulder_pan"] > 0
    rig.tick(xbox(deadman=True))
    for _ in range(300):
        rig.tick()
    assert rig.tick(xbox(deadman=True, right=1)).positions is None, "nobody knows whether it is still held"


def test_a_silent_pad_that_sends_only_changes_ends_its_motion(hidapi: FakeHidapi, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO)
    rig = Rig(hidapi, pad=Plugged(*XBOX))
    rig.tick(xbox(deadman=False))
    rig.tick(xbox(deadman=True, right=1))
    silent = [rig.tick().positions is None for _ in range(200)]
    assert silent.index(True) * TICK_S < 0.2
    assert all(silent[silent.index(True) :])
    assert all(rig.tick(xbox(deadman=True, right=1 - i / 100)).positions is None for i in range(20))
    assert "RELEASE the deadman" in rig.teleop.help()
    rig.tick(xbox(deadman=False))
    assert rig.tick(xbox(deadman=True, right=1)).positions is not None
    assert "pad: it reports only changes, so a motion ends when it is silent" in caplog.text


def test_a_trusted_link_lets_a_stick_be_still(hidapi: FakeHidapi):
    rig = Rig(hidapi, attrs.evolve(JOINTS, trust_link=True), pad=Plugged(*XBOX))
    rig.tick(xbox(deadman=False))
    rig.tick(xbox(deadman=True, right=1))
    assert all(rig.tick().positions is not None for _ in range(300))


def test_a_spacemouse_plugged_in_with_its_button_held_moves_nothing(hidapi: FakeHidapi):
    """Its first reports after a replug have no buttons, and a report of buttons may be the first of them."""
    mouse = hidapi.plug(Plugged(*SPACEMOUSE, usage=0x08))
    mouse.send(mouse_buttons())
    rig = Rig(hidapi, SpaceMouseOptions(cartesian=False, start="joints"), pad=mouse)
    rig.tick(mouse_buttons())
    assert rig.tick(mouse_buttons(0), spacemouse(yaw=1)).positions is not None
    hidapi.unplug(mouse)
    assert rig.tick().positions is None
    hidapi.plug(mouse)
    for _ in range(100):
        assert rig.tick(spacemouse(yaw=1)).positions is None
    for _ in range(10):
        assert rig.tick(mouse_buttons(0), spacemouse(yaw=1)).positions is None
    rig.tick(mouse_buttons())
    assert rig.tick(mouse_buttons(0), spacemouse(yaw=1)).positions is not None


def test_a_silent_spacemouse_ends_its_motion(hidapi: FakeHidapi):
    mouse = hidapi.plug(Plugged(*SPACEMOUSE, usage=0x08))
    mouse.send(mouse_buttons())
    rig = Rig(hidapi, SpaceMouseOptions(cartesian=False, start="joints"), pad=mouse)
    rig.tick(mouse_buttons())
    rig.tick(mouse_buttons(0), spacemouse(yaw=1))
    silent = [rig.tick().positions is None for _ in range(200)]
    assert silent.index(True) * TICK_S < 0.2
    assert rig.tick(spacemouse(yaw=0.9)).positions is None


def test_a_robot_waits_for_a_pad(hidapi: FakeHidapi, caplog: pytest.LogCaptureFixture):
    teleop = JogTeleop(JOINTS, host_context("pad"))
    teleop.connect()
    assert "pad: no gamepad is plugged in; the robot holds until one is" in caplog.text
    assert teleop.help().startswith("no gamepad yet: moves joints")
    teleop.disconnect()


def test_a_pad_without_permission_is_named(hidapi: FakeHidapi):
    hidapi.plug(Plugged(*DUALSENSE, permitted=False))
    with pytest.raises(TeleopError) as refused:
        JogTeleop(GamepadOptions(cartesian=False, via="hid"), host_context("pad")).connect()
    assert str(refused.value) == (
        "Pad (054c:0ce6, /dev/hidraw0) cannot be opened: open failed; `ibrobot doctor` says which permission is missing"
    )


def test_a_pad_that_comes_without_permission_is_reported_once(rig: Rig, caplog: pytest.LogCaptureFixture):
    rig.hidapi.unplug(rig.pad)
    rig.tick()
    rig.pad.permitted = False
    rig.hidapi.plug(rig.pad)
    rig.hold(3, dualsense(LB))
    assert caplog.text.count("cannot be opened") == 1
    rig.pad.permitted = True
    rig.hold(1, dualsense())
    rig.engage()


def test_the_named_pad_is_taken(hidapi: FakeHidapi):
    hidapi.plug(Plugged(*DUALSENSE, name="One", serial="aa", path=b"/dev/hidraw1"))
    wanted = hidapi.plug(Plugged(*DUALSENSE, name="Two", serial="bb:cc", path=b"/dev/hidraw2"))
    teleop = JogTeleop(GamepadOptions(cartesian=False, device="054C:0ce6:BB:cc"), host_context("pad"))
    teleop.connect()
    assert (wanted.opened, teleop.help().splitlines()[0]) == (1, "Two (054c:0ce6:bb:cc, DualSense): moves joints")
    teleop.disconnect()
    assert wanted.opened == 0


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(
    st.lists(st.binary(max_size=80) | st.binary(min_size=63, max_size=63).map(lambda rest: b"\x01" + rest), max_size=30)
)
def test_garbage_moves_nothing_and_raises_nothing(hidapi: FakeHidapi, reports: list[bytes]):
    """Reports of the right shape but random may press any button, so the deadman is one that they cannot reach."""
    hidapi.bus.clear()
    rig = Rig(hidapi, attrs.evolve(JOINTS, buttons={"deadman": "button31"}))
    for report in reports:
        assert rig.tick(report).positions is None
    assert rig.moved() == {}


def test_help_is_a_table_of_the_controls(rig: Rig):
    rig.tick(dualsense())
    assert rig.teleop.help().splitlines() == [
        "Pad (054c:0ce6, DualSense): moves joints",
        "joints   left_x shoulder_pan  left_y shoulder_lift  right_y elbow_flex  dpad_y wrist_flex  right_x wrist_roll",
        "buttons  left_shoulder deadman  left_trigger gripper_open  right_trigger gripper_close  east estop"
        "  start start  south success  right_stick failure  back discard  left_stick intervention",
        "poses    west home  north rest",
    ]


def test_the_spacemouse_gripper_button_closes_and_opens_in_turns(hidapi: FakeHidapi):
    mouse = hidapi.plug(Plugged(*SPACEMOUSE, usage=0x08))
    mouse.send(mouse_buttons())
    rig = Rig(hidapi, SpaceMouseOptions(cartesian=False, start="joints"), pad=mouse)
    gripper = []
    for _ in range(2):
        rig.tick(mouse_buttons())
        rig.tick(mouse_buttons(0))
        rig.hold(0.2, mouse_buttons(0, 1))
        gripper.append(rig.position[5])
        rig.tick(mouse_buttons(0))
    assert gripper[0] == pytest.approx(0.6 + 0.3)
    assert gripper[1] == pytest.approx(0.6)


def test_the_hook_offers_both():
    for descriptor in ibrobot_teleop():
        options = descriptor.options(cartesian=False, start="joints")
        assert isinstance(descriptor.make(options, host_context()), JogTeleop)
