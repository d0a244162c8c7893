"""The keyboard as an operator finds it: keys in, joint positions out, by the clock of the measurements."""

from __future__ import annotations

import os
import queue
from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_keyboard import ibrobot_teleop
from ibrobot_keyboard.options import KeyboardOptions
from ibrobot_keyboard.teleop import KeyboardTeleop
from ibrobot_terminal import KeyReader
from ibrobot_testing import TeleopSuite, host_context, make_robot

from ibrobot_core.api import Context, Description, Joint, JointReading, Robot, Teleop, TeleopCommand, TeleopError, ns

JOINTS = make_robot().joint_names
MIDDLE = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
TICK_S = 0.01


@attrs.define
class TeleopRig:
    """An operator at a keyboard, and a robot that reaches every setpoint at once."""

    robot: Robot = attrs.field(factory=make_robot)
    options: KeyboardOptions = KeyboardOptions(cartesian=False)
    position: np.ndarray = attrs.field(factory=MIDDLE.copy)
    time_s: float = 1000.0
    typed: queue.SimpleQueue[str] = attrs.field(factory=queue.SimpleQueue)
    teleop: KeyboardTeleop = attrs.field(init=False)

    def __attrs_post_init__(self) -> None:
        ctx = host_context("keyboard", robot=self.robot, keys=lambda: self.typed)
        self.teleop = KeyboardTeleop(self.options, ctx)
        self.teleop.connect()
        self.typed.put("release:z")  # the terminal reports releases
        self.teleop.begin_operation(self.measured())

    def measured(self) -> JointReading:
        return JointReading(ns(self.time_s), self.position.copy(), np.zeros(6), np.zeros(6))

    def tick(self, *keys: str, seconds: float = TICK_S) -> TeleopCommand:
        for key in keys:
            self.typed.put(key)
        self.time_s += seconds
        command = self.teleop.operate(self.measured())
        if command.positions is not None:
            self.position = np.array([command.positions[joint] for joint in self.robot.joint_names])
        return command

    def hold(self, key: str, seconds: float) -> None:
        """Keep a key down: it repeats every 30 ms."""
        for i in range(round(seconds / TICK_S) + 1):
            self.tick(*([key if i == 0 else f"repeat:{key}"] if i % 3 == 0 else []))

    def rest(self) -> None:
        """Let go of all keys until nothing moves."""
        while self.tick().positions is not None:
            pass

    def moved(self) -> dict[str, float]:
        way = self.position - MIDDLE
        return {joint: way[i] for i, joint in enumerate(self.robot.joint_names) if abs(way[i]) > 1e-9}


class TestKeyboard(TeleopSuite):
    step_rad = 0.1  # motion goes on from the last setpoint

    @override
    def context(self) -> Context:
        self.typed: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.ctx = host_context(keys=lambda: self.typed)
        return self.ctx

    @override
    def make(self, ctx: Context) -> Teleop:
        return KeyboardTeleop(KeyboardOptions(cartesian=False), ctx)

    @override
    def engage(self, teleop: Teleop) -> None:
        for event in ("release:w", "w"):
            self.typed.put(event)

    @override
    def operate(self, teleop: Teleop) -> None:
        self.typed.put("repeat:w")

    @override
    def release(self, teleop: Teleop) -> None:
        self.typed.put("release:w")


PAIRS = [("w", "s"), ("e", "d"), ("r", "f"), ("t", "g"), ("y", "h")]


@pytest.mark.parametrize(("joint", "keys"), list(zip(JOINTS, PAIRS, strict=False)))
def test_each_joint_has_a_key_up_and_a_key_down(joint, keys):
    for key, sign in zip(keys, (1, -1), strict=True):
        rig = TeleopRig()
        rig.hold(key, 0.4)
        assert rig.moved() == pytest.approx({joint: sign * 0.5 * 0.4})


def test_a_tap_moves_for_the_hold_time_and_not_longer():
    rig = TeleopRig()
    commands = [rig.tick("w"), *(rig.tick() for _ in range(30))]
    moving = [c.positions is not None for c in commands]
    assert moving == [True] * 15 + [False] * 16
    assert rig.moved() == pytest.approx({"shoulder_pan": 0.5 * 0.14})


def test_a_held_key_moves_without_a_break():
    rig = TeleopRig()
    for i in range(100):
        assert rig.tick(*([f"{'repeat:' if i else ''}w"] if i % 9 == 0 else [])).positions is not None


def test_without_keys_there_are_no_positions():
    assert TeleopRig().tick() == TeleopCommand(None)


def test_motion_goes_on_from_the_last_setpoint_and_not_from_where_the_arm_sags():
    rig = TeleopRig()
    rig.hold("w", 0.2)
    rig.rest()
    reached = rig.position[0]
    rig.position[0] -= 0.05
    positions = rig.tick("w").positions
    assert positions is not None
    assert positions["shoulder_pan"] == reached


def test_activation_begins_where_the_robot_is_and_forgets_what_was_typed():
    rig = TeleopRig()
    rig.tick("w")
    rig.position = np.zeros(6)
    for key in ("w", "space"):
        rig.typed.put(key)
    rig.teleop.begin_operation(rig.measured())
    assert rig.tick() == TeleopCommand(None)
    assert rig.tick("e").positions == dict.fromkeys(JOINTS, 0.0)


def test_two_keys_move_two_joints_and_the_newer_of_opposite_keys_wins():
    rig = TeleopRig()
    rig.tick("w", "e")
    rig.tick(seconds=0.1)
    assert rig.moved() == pytest.approx({"shoulder_pan": 0.05, "shoulder_lift": 0.05})
    rig.tick("s")
    rig.tick(seconds=0.1)
    assert rig.moved()["shoulder_pan"] < 0.05


def test_no_key_drives_a_joint_out_of_its_limits():
    rig = TeleopRig()
    rig.hold("w", 10)
    assert rig.position[0] == 1.8
    rig.hold("s", 10)
    assert rig.position[0] == -1.9


def test_a_joint_outside_its_limits_may_only_come_in():
    rig = TeleopRig(position=np.array([2.0, 0, 0, 0, 0, 0]))
    rig.hold("w", 0.3)
    assert rig.position[0] == 2.0
    rig.rest()
    rig.hold("s", 0.3)
    assert rig.position[0] == pytest.approx(2.0 - 0.15)


def test_gripper_keys_open_and_close_it():
    rig = TeleopRig()
    rig.hold("o", 0.3)
    assert rig.moved() == pytest.approx({"gripper": 0.3})
    rig.hold("c", 3)
    assert rig.position[5] == -0.2


def test_the_home_key_goes_straight_home_at_joint_speed_while_it_is_held():
    rig = TeleopRig()
    rig.hold("0", 0.4)
    np.testing.assert_allclose(rig.position, MIDDLE * (1 - 0.5 * 0.4 / 0.6))
    rig.tick("w")
    before = rig.position.copy()
    rig.tick(seconds=0.1)
    np.testing.assert_allclose(rig.position - before, [0.05, 0, 0, 0, 0, 0], atol=1e-12)
    rig.hold("0", 2)
    np.testing.assert_array_equal(rig.position, np.zeros(6))


def test_speed_keys_change_the_speed_within_bounds():
    rig = TeleopRig()
    rig.tick("+", "+")
    rig.hold("w", 0.2)
    assert rig.moved() == pytest.approx({"shoulder_pan": 0.5 * 1.25**2 * 0.2})
    slow = TeleopRig()
    slow.tick(*["-"] * 50)
    slow.hold("w", 0.2)
    assert slow.moved() == pytest.approx({"shoulder_pan": 0.5 * 0.1 * 0.2})


def test_no_joint_goes_faster_than_its_own_limit():
    rig = TeleopRig(options=KeyboardOptions(cartesian=False, joint_speed=50.0, gripper_speed=50.0))
    path = []
    for _ in range(20):
        rig.tick("w", "o")
        path.append(rig.position.copy())
    speeds = np.diff(path, axis=0).max(axis=0) / TICK_S
    assert speeds[0] == pytest.approx(2.0)
    assert speeds[5] == pytest.approx(3.25)


def test_a_host_that_stood_still_makes_no_leap():
    rig = TeleopRig()
    rig.tick("w")
    rig.tick(*["repeat:w"] * 60, seconds=5.0)
    for _ in range(30):
        rig.tick("repeat:w")
    assert rig.moved() == {}
    rig.tick("release:w")
    rig.tick("w")
    rig.tick(seconds=0.1)
    assert rig.moved() == pytest.approx({"shoulder_pan": 0.05})


def test_keys_of_the_runtime_and_unknown_ones_do_nothing():
    rig = TeleopRig()
    for key in ("esc", "tab", "f1", "f10", "ü", "m"):
        assert rig.tick(key) == TeleopCommand(None)


def test_keys_can_be_given_other_actions():
    keys = {"shoulder_pan+": "right", "shoulder_pan-": "left", "gripper_open": "w"}
    rig = TeleopRig(options=KeyboardOptions(cartesian=False, keys=keys))
    rig.hold("left", 0.2)
    rig.hold("w", 0.2)
    # The hold time of the first key runs on for a while beside the second.
    assert set(rig.moved()) == {"shoulder_pan", "gripper"}
    assert rig.moved()["shoulder_pan"] < 0 < rig.moved()["gripper"]


WRONG_KEYS = {
    "unknown action": ({"shoulder_pam+": "1"}, "keys: no action 'shoulder_pam+', did you mean 'shoulder_pan+'?"),
    "nothing like it": (
        {"zzz": "1"},
        "keys: no action 'zzz', the actions are: elbow_flex+, elbow_flex-, faster",
    ),
    "taken": ({"shoulder_pan+": "o"}, "keys: 'o' is assigned to both shoulder_pan+ and gripper_open"),
}


@pytest.mark.parametrize(("keys", "message"), WRONG_KEYS.values(), ids=WRONG_KEYS.keys())
def test_keys_that_make_no_sense_are_refused(keys, message):
    with pytest.raises(TeleopError) as refused:
        TeleopRig(options=KeyboardOptions(cartesian=False, keys=keys))
    assert str(refused.value).startswith(message)


@pytest.mark.parametrize("count", [8, 9, 14, 16, 30])
def test_joints_after_the_seventh_have_no_default_keys(count):
    robot = Robot("long", tuple(Joint(f"j{i}", -1, 1, 1, 1) for i in range(count)))
    lines = KeyboardTeleop(KeyboardOptions(cartesian=False), host_context(robot=robot)).help().splitlines()
    assert lines[0].endswith("i/k j6")
    keyless = ", ".join(f"j{i}" for i in range(7, count))
    assert lines[1] == f"no keys    {keyless}: set them under keys, e.g. j7+: '1', j7-: '2'"
    assert list(KeyboardOptions(cartesian=False).check(robot, robot.joint_names)) == []


def test_more_joints_than_keys_can_have_keys_of_their_own():
    robot = Robot("long", tuple(Joint(f"j{i}", -1, 1, 1, 1) for i in range(8)))
    with pytest.raises(TeleopError, match=r"no default key is left for j7-: set one under keys, e\.g\. j7-: '1'"):
        KeyboardTeleop(KeyboardOptions(cartesian=False, keys={"j7+": "1"}), host_context(robot=robot))
    options = KeyboardOptions(cartesian=False, keys={"j7+": "1", "j7-": "2"})
    assert "1/2 j7" in KeyboardTeleop(options, host_context(robot=robot)).help()


def test_help_is_a_table_of_the_available_keys():
    assert TeleopRig().teleop.help().splitlines() == [
        "joints     w/s shoulder_pan  e/d shoulder_lift  r/f elbow_flex  t/g wrist_flex  y/h wrist_roll",
        "always     o gripper_open  c gripper_close  0 home  + faster  - slower",
    ]
    bare = attrs.evolve(make_robot(), groups={}, description=Description())
    assert TeleopRig(robot=bare).teleop.help().splitlines() == [
        "joints     w/s shoulder_pan  e/d shoulder_lift  r/f elbow_flex  t/g wrist_flex  y/h wrist_roll  u/j gripper",
        "always     + faster  - slower",
    ]


def test_without_a_terminal_it_says_what_to_do():
    with pytest.raises(TeleopError, match="the keyboard needs a terminal: start ibrobot in one"):
        KeyboardTeleop(KeyboardOptions(cartesian=False), host_context()).connect()


def test_typing_in_a_terminal_moves_a_joint():
    person, program = os.openpty()
    try:
        with KeyReader(program) as keys:
            seen = keys.subscribe()
            teleop = KeyboardTeleop(KeyboardOptions(cartesian=False), host_context(keys=keys.subscribe))
            teleop.connect()
            os.write(person, b"w")
            assert seen.get(timeout=60) == "w"
            # The reader feeds its subscribers one after another under one lock; subscribing again waits for that.
            keys.subscribe()
            _, first, second = (
                teleop.operate(JointReading(ns(t), MIDDLE.copy(), np.zeros(6), np.zeros(6))) for t in (1.0, 1.15, 1.2)
            )
    finally:
        os.close(person)
        os.close(program)
    assert first.positions is not None
    assert second.positions is not None
    assert first.positions["shoulder_pan"] == 0.1
    assert second.positions["shoulder_pan"] == pytest.approx(0.125)


def legacy_rig() -> TeleopRig:
    """In a terminal that reports presses alone."""
    rig = TeleopRig()
    rig.teleop.disconnect()
    rig.typed = queue.SimpleQueue()
    rig.teleop = KeyboardTeleop(rig.options, host_context("keyboard", robot=rig.robot, keys=lambda: rig.typed))
    rig.teleop.connect()
    rig.teleop.begin_operation(rig.measured())
    rig.tick()
    return rig


def press(rig: TeleopRig, ticks: range, key: str = "w") -> list[bool]:
    """Whether the robot may move at each tick since the press of a key that repeats after 0.4 s, every 30 ms."""
    return [rig.tick(*[key] * (tick == 0 or (tick >= 40 and tick % 3 == 1))).positions is not None for tick in ticks]


def test_without_reports_of_releases_a_held_key_moves_and_its_release_ends_the_motion():
    rig = legacy_rig()
    moves = press(rig, range(100))
    assert moves.index(True) == 15, "a press counts once it is clear that it is none of many repeats"
    assert all(moves[45:])
    after = [rig.tick().positions is not None for _ in range(30)]
    assert sum(after) <= 16
    assert press(rig, range(20))[-1], "the next press counts"


@pytest.mark.parametrize("pressed_before", [5, 30, 60], ids=["just pressed", "before its first repeat", "repeating"])
def test_a_key_held_over_an_activation_moves_nothing(pressed_before: int):
    rig = legacy_rig()
    press(rig, range(pressed_before))
    rig.teleop.begin_operation(rig.measured())
    assert not any(press(rig, range(pressed_before, 300)))
    for _ in range(30):
        rig.tick()
    assert any(press(rig, range(20)))


def test_a_terminal_that_stalls_sends_repeats_that_move_nothing():
    rig = legacy_rig()
    press(rig, range(100))
    for _ in range(200):
        rig.tick()
    assert rig.tick(*["w"] * 66).positions is None
    assert not any(press(rig, range(301, 500)))


def test_the_hook_offers_the_keyboard():
    (descriptor,) = ibrobot_teleop()
    assert isinstance(descriptor.make(descriptor.options(), host_context()), KeyboardTeleop)
