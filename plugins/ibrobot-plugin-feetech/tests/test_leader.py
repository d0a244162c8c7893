"""The leader against the emulated bus: mapping, approach, deadman, lost replies, and coming back."""

from __future__ import annotations

import math
import queue
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.leader import LeaderTeleop, read_pose
from ibrobot_feetech.options import LeaderOptions
from ibrobot_testing import TeleopSuite
from ibrobot_testing.contexts import START_NS, host_context, make_robot

from ibrobot_core.api import (
    Context,
    Description,
    JointReading,
    Robot,
    SteppedClock,
    Teleop,
    TeleopCommand,
    TeleopError,
    Vector,
)

from .conftest import JOINTS, OFFSETS, arm_calibration, prepare
from .line import Line

TICK_NS = 10_000_000
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""


@pytest.fixture(autouse=True)
def _in_memory(lines: None) -> None:
    pass


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Line(6) as emulator:
        prepare(emulator, arm_calibration())
        yield emulator


class LeaderSuite(TeleopSuite):
    @pytest.fixture(autouse=True)
    def _arm(self, calibration_file: Path) -> Iterator[None]:
        self.file, self.typed = calibration_file, queue.SimpleQueue[str]()
        with Line(6) as self.emulator:
            prepare(self.emulator, arm_calibration())
            yield

    @override
    def context(self) -> Context:
        return host_context(keys=lambda: self.typed)

    def leader(self, ctx: Context, deadman: str) -> Teleop:
        return LeaderTeleop(LeaderOptions(self.emulator.port, str(self.file), deadman=deadman), ctx)

    way = 100

    @override
    def operate(self, teleop: Teleop) -> None:
        self._turn(100)

    @override
    def hold(self, teleop: Teleop) -> None:
        self.way = -self.way
        self._turn(self.way)

    def _turn(self, ticks: int) -> None:
        with self.emulator.lock:
            for servo in self.emulator.servos.values():
                servo.turn(servo.encoder + ticks)


class TestWithoutADeadman(LeaderSuite):
    has_deadman = False

    @override
    def context(self) -> Context:
        self.clock = SteppedClock(START_NS)
        return host_context(clock=self.clock)

    @override
    def make(self, ctx: Context) -> Teleop:
        return self.leader(ctx, "none")

    @override
    def engage(self, teleop: Teleop) -> None:
        """Somebody takes the leader up."""
        still = np.zeros(6)
        teleop.operate(JointReading(self.clock.now_ns(), still, still, still))
        self.operate(teleop)


class TestToggle(LeaderSuite):
    @override
    def make(self, ctx: Context) -> Teleop:
        return self.leader(ctx, "toggle")

    @override
    def engage(self, teleop: Teleop) -> None:
        for event in ("release:space", "space"):
            self.typed.put(event)

    release = engage

    @override
    def rest(self, teleop: Teleop) -> None:
        """It is paused."""

    @override
    def freeze(self, teleop: Teleop) -> None:
        freeze(self.emulator)


class TestHold(LeaderSuite):
    @override
    def make(self, ctx: Context) -> Teleop:
        return self.leader(ctx, "hold")

    @override
    def engage(self, teleop: Teleop) -> None:
        for event in ("release:space", "space", "repeat:space"):
            self.typed.put(event)

    @override
    def hold(self, teleop: Teleop) -> None:
        super().hold(teleop)
        self.typed.put("repeat:space")

    @override
    def release(self, teleop: Teleop) -> None:
        self.typed.put("release:space")

    @override
    def freeze(self, teleop: Teleop) -> None:
        freeze(self.emulator)

    @override
    def context(self) -> Context:
        self.clock = SteppedClock(START_NS)
        return host_context(clock=self.clock, keys=lambda: self.typed)


def freeze(emulator: Emulator) -> None:
    """No servo answers any more."""
    emulator.faults.silent.update(emulator.servos)


class TeleopRig:
    """A leader and a robot that reaches every setpoint at once."""

    def __init__(self, emulator: Emulator, file: Path, link: Path | None = None, **options: Any) -> None:
        self.emulator, self.clock = emulator, SteppedClock(START_NS)
        self.typed = queue.SimpleQueue[str]()
        ctx = host_context("leader", clock=self.clock, keys=lambda: self.typed)
        self.leader = LeaderTeleop(LeaderOptions(str(link or emulator.port), str(file), **options), ctx)
        self.position: Vector = np.zeros(6)
        self.waiting = ""
        """A key that is typed when the leader is read next, but not while it is turned."""
        self.follows = False
        """Whether the robot follows the leader."""

    def begin(self) -> None:
        """Begin the mode, and see the deadman released; the terminal reports releases."""
        self.leader.begin_operation(self.measured())
        self.read("release:space", "release:l")

    def read(self, *keys: str) -> TeleopCommand:
        for key in (self.waiting, *keys) if self.waiting else keys:
            self.typed.put(key)
        self.waiting = ""
        command = self.leader.operate(self.measured())
        self.follows = command.positions is not None
        if command.positions is not None:
            for joint, position in command.positions.items():
                self.position[JOINTS.index(joint)] = position
        return command

    def measured(self) -> JointReading:
        self.clock.advance(TICK_NS)
        return JointReading(self.clock.now_ns(), self.position.copy(), np.zeros(6), np.zeros(6))

    def follow(self, reads: int = 300) -> Vector:
        for _ in range(reads):
            self.read()
        return self.position

    def turn(self, joint: str, ticks: float, in_ns: int = 500_000_000, *, read: bool = True) -> None:
        """Move a joint of the leader to a reported position [ticks], after some time."""
        index = JOINTS.index(joint)
        servo, goal = self.emulator.servos[index + 1], ticks + OFFSETS[index]
        steps = in_ns // TICK_NS if read else 1
        typed, self.waiting = self.waiting, ""
        for step in range(steps):
            with self.emulator.lock:
                servo.turn(servo.encoder + (goal - servo.encoder) / (steps - step))
            if read:
                self.read()
            else:
                self.clock.advance(in_ns)
        self.waiting = typed

    def register(self, name: str) -> list[int]:
        with self.emulator.lock:
            return [servo.get(name) for servo in self.emulator.servos.values()]


@pytest.fixture
def rig(emulator: Emulator, calibration_file: Path, request: pytest.FixtureRequest) -> Iterator[TeleopRig]:
    given = getattr(request, "param", {})
    rig = TeleopRig(emulator, calibration_file, **given)
    rig.leader.connect()
    if given.get("deadman") == "none":
        rig.leader.begin_operation(rig.measured())
    else:
        rig.begin()
    if "deadman" not in given:
        rig.waiting = "space"
    yield rig
    rig.leader.disconnect()


def options(**given: Any) -> Any:
    return pytest.mark.parametrize("rig", [given], indirect=True)


class TestMapping:
    def test_angles_are_the_robots(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2048 + 0.5 * RADIAN)
        rig.turn("elbow_flex", 2048 + 0.4 * RADIAN)  # drive_mode 1
        position = rig.follow()
        assert position[JOINTS.index("shoulder_pan")] == pytest.approx(0.5, abs=1e-3)
        assert position[JOINTS.index("elbow_flex")] == pytest.approx(-0.4, abs=1e-3)

    @pytest.mark.parametrize("rig", [{}, {"inverted": ("gripper",)}], indirect=True, ids=["", "inverted"])
    @pytest.mark.parametrize("share", [-0.1, 0.0, 0.25, 0.8, 1.0, 1.1])
    def test_the_triggers_range_is_the_grippers(self, rig: TeleopRig, share: float, request: pytest.FixtureRequest):
        rig.turn("gripper", 1500 + share * 1500)
        opened = 1 - share if "inverted" in request.node.callspec.id else share
        assert rig.follow()[5] == pytest.approx(-0.2 + np.clip(opened, 0, 1) * 1.9, abs=1e-9)

    @options(inverted=("shoulder_pan",))
    def test_an_inverted_joint_turns_the_other_way(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2048 + 0.5 * RADIAN)
        assert rig.follow()[0] == pytest.approx(-0.5, abs=1e-3)

    @options(joints={"wrist_roll": "shoulder_pan"})
    def test_only_mapped_joints_are_commanded(self, rig: TeleopRig):
        rig.turn("wrist_roll", 2048 + 0.5 * RADIAN)
        rig.follow()
        assert rig.read().positions == pytest.approx({"shoulder_pan": 0.5}, abs=1e-3)

    @options(deadman_key="l")
    def test_the_deadman_may_have_another_key(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2048 + 0.5 * RADIAN)
        assert rig.read().positions is None, "space is another device's"
        assert rig.leader.help() == "PAUSED: press l to follow the leader arm"
        rig.read("l")
        assert rig.follow()[0] == pytest.approx(0.5, abs=1e-3)

    def test_the_robots_limits_hold(self, rig: TeleopRig):
        rig.turn("wrist_flex", 600)
        assert rig.follow()[3] == -1.5

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"joints": {"shoulder_pan": "sholder"}}, "joints: no joint 'sholder'; the joints are: shoulder_pan"),
            ({"inverted": ("roll",)}, "inverted: no joint 'roll'; the joints are: shoulder_pan, shoulder_lift"),
            ({"scaled": ("grip",)}, "scaled: no joint 'grip'; the joints are: shoulder_pan, shoulder_lift"),
        ],
    )
    def test_unknown_joints_are_reported(self, emulator: Emulator, calibration_file: Path, given: Any, message: str):
        with pytest.raises(TeleopError, match=message):
            TeleopRig(emulator, calibration_file, **given)


class TestApproach:
    @options(ramp_velocity=1.0)
    def test_is_bounded_in_proportion_and_ends_in_following(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2048 + 0.8 * RADIAN)
        rig.turn("wrist_roll", 2048 - 0.4 * RADIAN)
        path = [rig.position.copy()]
        for _ in range(200):
            rig.read()
            path.append(rig.position.copy())
        steps = np.diff(path, axis=0)
        assert np.abs(steps).max() <= 0.021, "10 ms at 1 rad/s, or the tolerance at the end"
        # On the way the two joints have gone the same share of theirs.
        middle = path[40]
        assert middle[0] / 0.8 == pytest.approx(middle[4] / -0.4, abs=1e-3)
        assert 0.3 < middle[0] < 0.5
        assert path[-1][0] == pytest.approx(0.8, abs=1e-3)
        rig.turn("shoulder_pan", 2048 + 0.9 * RADIAN)
        rig.read()
        assert rig.position[0] == pytest.approx(0.9, abs=1e-3), "it follows directly"

    def test_after_a_host_that_stood_still_it_waits_for_a_new_press(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2048 + 1.5 * RADIAN)
        rig.follow(3)
        before = rig.position[0]
        rig.clock.advance(5_000_000_000)
        rig.follow(100)
        assert rig.position[0] == before
        rig.read("space")
        rig.follow(100)
        assert rig.position[0] > before + 0.5


class TestTakeover:
    """The motors of the leader move it to the robot's pose, and let go."""

    def approach(self, rig: TeleopRig, ticks: int = 400) -> list[Vector]:
        """The leader's positions on the way [ticks]."""
        way = []
        for _ in range(ticks):
            Line.now_s += TICK_NS * 1e-9
            arrived = rig.leader.approach(rig.measured())
            way.append(np.array(rig.register("present_position"), dtype=float))
            if arrived:
                return way
        pytest.fail("it does not arrive")

    def test_the_leader_arrives_at_the_robots_pose_and_lets_go(self, rig: TeleopRig):
        rig.position[:] = (0.5, -0.3, 0.2, 0.1, -0.4, 0.4)
        way = self.approach(rig)
        assert np.abs(np.diff(way, axis=0)).max() < 1.5 * RADIAN * 0.01 * 2, "at ramp_velocity, 1 rad/s"
        assert rig.register("torque_enable") == [0] * 6
        rig.begin()
        rig.typed.put("space")
        held = rig.position.copy()
        np.testing.assert_allclose(rig.follow(), held, atol=0.05)

    def test_a_hand_that_holds_the_leader_wins(self, rig: TeleopRig):
        rig.position[0] = 1.0
        servo = rig.emulator.servos[1]
        servo.drive(servo.encoder, 0.0)
        assert 200 < len(self.approach(rig)) < 400
        assert rig.register("torque_enable") == [0] * 6

    def test_the_torque_is_off_if_the_takeover_is_broken_off(self, rig: TeleopRig):
        rig.position[0] = 1.0
        for end in (lambda: rig.leader.begin_operation(rig.measured()), rig.leader.disconnect):
            assert not rig.leader.approach(rig.measured())
            assert rig.register("torque_enable") == [1] * 6
            end()
            assert rig.register("torque_enable") == [0] * 6

    @options(driven=False)
    def test_without_the_option_its_motors_stay_off(self, rig: TeleopRig):
        rig.position[0] = 1.0
        assert rig.leader.approach(rig.measured())
        assert rig.register("torque_enable") == [0] * 6


class TestDeadman:
    def test_without_a_word_in_the_yaml_it_waits_for_space(self, emulator: Emulator, calibration_file: Path):
        rig = TeleopRig(emulator, calibration_file)
        rig.leader.connect()
        rig.begin()
        rig.turn("shoulder_pan", 2500)
        assert [rig.read().positions for _ in range(50)] == [None] * 50
        assert rig.leader.help().startswith("PAUSED: press space to follow")
        assert rig.read("space").positions is not None
        assert rig.leader.help().startswith("following the leader arm: space pauses")
        rig.leader.disconnect()

    @options(deadman="none")
    def test_none_follows_once_the_leader_is_taken_up(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2500, read=False)
        assert [rig.read().positions for _ in range(50)] == [None] * 50
        assert rig.leader.help().startswith("PAUSED: move the leader arm")
        rig.turn("shoulder_pan", 2510)
        assert rig.read().positions is None, "it trembles"
        rig.turn("shoulder_pan", 2600)
        assert rig.follow()[0] == pytest.approx(552 / RADIAN, abs=1e-3)
        rig.leader.begin_operation(rig.measured())
        assert rig.read().positions is None, "a reset waits again"

    @options(deadman="none")
    def test_a_lost_reply_at_the_start_causes_no_motion(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 2500, read=False)
        rig.emulator.faults.silent.add(1)
        assert rig.read().positions is None
        rig.emulator.faults.silent.clear()
        assert [rig.read().positions for _ in range(50)] == [None] * 50

    @options(deadman="toggle", ramp_velocity=1.0)
    def test_a_pause_ends_in_the_same_approach(self, rig: TeleopRig):
        assert rig.read().positions is None
        rig.read("space")
        rig.follow(200)
        rig.read("space")
        rig.turn("shoulder_pan", 2048 + 1.0 * RADIAN)
        before = rig.position.copy()
        assert [rig.read().positions for _ in range(50)] == [None] * 50
        rig.read("space")
        np.testing.assert_array_equal(rig.position, before)
        rig.read()
        assert rig.position[0] - before[0] == pytest.approx(0.01, abs=1e-6)

    @options(deadman="hold")
    def test_held_follows_while_the_key_repeats_and_a_single_press_does_nothing(self, rig: TeleopRig):
        assert rig.read("space").positions is None
        assert [rig.read().positions for _ in range(50)] == [None] * 50
        assert all(rig.read(*["repeat:space"] * (i % 3 == 0)).positions is not None for i in range(30))
        assert "hold space to follow the leader arm" in rig.leader.help() or rig.follows
        assert rig.read("release:space").positions is None

    def test_a_held_key_without_reports_of_releases(self, emulator: Emulator, calibration_file: Path):
        """It repeats after 0.4 s, every 30 ms: `toggle` starts once and pauses, `hold` follows while it repeats."""
        follows = {}
        for deadman in ("toggle", "hold"):
            rig = TeleopRig(emulator, calibration_file, deadman=deadman)
            rig.leader.connect()
            rig.leader.begin_operation(rig.measured())
            rig.read()
            keys = [["space"] * (i == 0 or (i >= 40 and i % 3 == 1)) for i in range(200)]
            follows[deadman] = [rig.read(*typed).positions is not None for typed in (*keys, *[[]] * 100)]
            rig.leader.disconnect()
        assert np.flatnonzero(follows["toggle"]).tolist() == list(range(15, 40))
        assert np.flatnonzero(follows["hold"]).tolist() == list(range(40, 220))
        assert "known by its repeats" in LeaderTeleop.help(rig.leader)

    def test_toggle_without_reports_of_releases_starts_and_pauses_by_one_press_each(self, emulator, calibration_file):
        rig = TeleopRig(emulator, calibration_file, deadman="toggle")
        rig.leader.connect()
        rig.leader.begin_operation(rig.measured())
        follows = [rig.read(*["space"] * (i in (10, 200, 500))).positions is not None for i in range(600)]
        rig.leader.disconnect()
        assert np.flatnonzero(follows).tolist() == [*range(25, 200), *range(515, 600)]

    @options(deadman="toggle")
    def test_key_repeats_are_no_presses(self, rig: TeleopRig):
        rig.read("space")
        assert all(rig.read(*["repeat:space"] * (i % 3 == 0)).positions is not None for i in range(200))
        rig.read("release:space")
        assert rig.follows
        assert rig.read("space").positions is None

    @options(deadman="toggle")
    def test_what_was_typed_before_the_mode_began_does_not_count(self, rig: TeleopRig):
        rig.typed.put("space")
        rig.leader.begin_operation(rig.measured())
        assert rig.read().positions is None

    def test_without_a_terminal_it_is_refused(self, emulator: Emulator, calibration_file: Path):
        given = LeaderOptions(emulator.port, str(calibration_file), deadman="hold")
        with pytest.raises(TeleopError, match="deadman: hold needs a terminal"):
            LeaderTeleop(given, host_context("leader")).connect()


class TestBus:
    def test_torque_is_off_and_answers_come_without_delay(self, emulator: Emulator, calibration_file: Path):
        for servo in emulator.servos.values():
            servo.set("torque_enable", 1)
        rig = TeleopRig(emulator, calibration_file)
        rig.leader.connect()
        rig.leader.disconnect()
        assert rig.register("torque_enable") == [0] * 6
        assert rig.register("return_delay") == [0] * 6
        assert rig.register("lock") == [1] * 6

    def test_another_calibration_is_refused(self, emulator: Emulator, calibration_file: Path):
        emulator.servos[4].set("homing_offset", 12)
        with pytest.raises(TeleopError, match=r"servo 4 \(wrist_flex\), homing_offset: the servo has 12, .* says 900"):
            TeleopRig(emulator, calibration_file).leader.connect()

    def test_missing_servos_are_named_together(self, emulator: Emulator, calibration_file: Path):
        emulator.faults.silent |= {2, 5}
        with pytest.raises(TeleopError, match=r"leader: .*2 \(shoulder_lift\), 5 \(wrist_roll\)"):
            TeleopRig(emulator, calibration_file).leader.connect()

    def test_single_lost_replies_hold_the_position_and_many_are_an_error_with_a_name(self, rig: TeleopRig):
        rig.follow()
        rig.emulator.faults.silent.add(3)
        for _ in range(3):
            assert rig.read().positions is not None
        rig.emulator.faults.silent.clear()
        rig.read()
        rig.emulator.faults.silent.add(3)
        before = rig.position.copy()
        rig.follow(3)
        np.testing.assert_array_equal(rig.position, before)
        with pytest.raises(TeleopError, match=r"servo 3 \(elbow_flex\): no reply, 4 times in a row"):
            rig.read()

    def test_a_position_that_no_hand_can_reach_is_not_followed(self, rig: TeleopRig):
        rig.turn("shoulder_pan", 3000)
        before = rig.follow().copy()
        rig.turn("shoulder_pan", 100, in_ns=0, read=False)
        rig.follow(3)
        np.testing.assert_array_equal(rig.position, before)
        with pytest.raises(TeleopError, match=r"servo 1 \(shoulder_pan\): position 100 right after 3000"):
            rig.read()

    def test_unplugged_it_says_so_and_replugged_it_connects(self, ports: None, tmp_path: Path, calibration_file: Path):
        link = tmp_path / "port"
        with Emulator(6, link=link) as emulator:
            prepare(emulator, arm_calibration())
            rig = TeleopRig(emulator, calibration_file, link)
            rig.leader.connect()
            rig.begin()
            rig.read("space")
            emulator.unplug()
            with pytest.raises(TeleopError, match=r"leader: .*port: the port is"):
                rig.read()
            rig.leader.disconnect()
            with pytest.raises(TeleopError, match=r"leader: .*port: there is no such port"):
                rig.leader.connect()
            emulator.replug()
            rig.leader.connect()
            rig.begin()
            assert rig.read().positions is None, "it waits to be started again"
            assert rig.read("space").positions is not None
            rig.leader.disconnect()


class TestOneOfTwo:
    """The leader of one arm of a robot with two."""

    def robot(self) -> Robot:
        one = make_robot()
        joints = tuple(
            attrs.evolve(joint, name=f"{side}_{joint.name}") for side in ("left", "right") for joint in one.joints
        )
        groups = {side: tuple(f"{side}_{name}" for name in JOINTS) for side in ("left", "right")}
        return attrs.evolve(one, joints=joints, groups=groups, description=Description())

    def test_it_moves_the_joints_with_its_prefix(self, emulator: Emulator, calibration_file: Path):
        ctx = host_context("leader", robot=self.robot().part("right"))
        leader = LeaderTeleop(LeaderOptions(emulator.port, str(calibration_file), prefix="right_", deadman="none"), ctx)
        leader.connect()
        still = JointReading(START_NS, np.zeros(6), np.zeros(6), np.zeros(6))
        leader.begin_operation(still)
        leader.operate(attrs.evolve(still, stamp_ns=START_NS + 10_000_000))
        with emulator.lock:
            emulator.servos[1].turn(emulator.servos[1].encoder + 100)
        positions = leader.operate(attrs.evolve(still, stamp_ns=START_NS + 100_000_000)).positions
        leader.disconnect()
        assert positions == dict.fromkeys((f"right_{name}" for name in JOINTS), 0.0), "it begins where the robot is"

    def test_a_prefix_that_does_not_fit_is_a_fault(self):
        options = LeaderOptions("/dev/null", "leader", prefix="right_")
        assert list(options.check(self.robot().part("right"), ())) == []
        for robot in (self.robot().part("left"), self.robot()):
            (fault,) = options.check(robot, ())
            assert fault.option == ("prefix",)
            assert fault.message == (
                "joint 'left_shoulder_pan' does not begin with 'right_'; give the device its arm in the mode, e.g. "
                "teleop: {left: DEVICE}, where left is a joint group"
            )

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"prefix": "left_", "joints": {"gripper": "left_gripper"}}, "joints and prefix exclude each other"),
        ],
    )
    def test_options_that_exclude_each_other(self, given: dict[str, Any], message: str):
        with pytest.raises(ValueError, match=message):
            LeaderOptions("/dev/null", "leader", **given)


def test_pose_is_read_without_a_terminal(emulator, calibration_file):
    """Also where the robot's limits end, and the torque is off then."""
    options = LeaderOptions(port=emulator.port, calibration=str(calibration_file), scaled=())
    emulator.servos[1].turn(3500 + OFFSETS[0])
    pose = read_pose(options, host_context())
    assert set(pose) == set(JOINTS)
    assert pose["shoulder_pan"] > 1.8
    assert not any(servo.get("torque_enable") for servo in emulator.servos.values())
    with pytest.raises(TeleopError, match="nowhere"):
        read_pose(attrs.evolve(options, port="nowhere"), host_context())
