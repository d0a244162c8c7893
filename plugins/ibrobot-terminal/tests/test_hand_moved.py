"""What the robot does behind a device that a hand moves: when it follows, and how it comes to the device's pose."""

from __future__ import annotations

import queue

import attrs
import numpy as np
import pytest
from ibrobot_terminal.hand_moved import HandMoved
from ibrobot_terminal.hand_moved_options import HandMovedOptions
from ibrobot_testing.contexts import host_context

from ibrobot_core.api import Deadman, TeleopCommand, TeleopError, Vector, ns

MOVED = 0.05
TICK_NS = ns(0.02)
START_NS = ns(100.0)
SPEED = np.array([1.0, 1.0])


@attrs.define
class Bench:
    """A robot of two joints that goes where it is told at once, and a device."""

    deadman: str
    keys: queue.SimpleQueue[str] = attrs.field(factory=queue.SimpleQueue)
    device: Vector = attrs.field(factory=lambda: np.array([0.5, -0.25]))
    robot: Vector = attrs.field(factory=lambda: np.zeros(2))
    now_ns: int = START_NS
    pressed: Deadman = attrs.field(factory=Deadman)
    hand: HandMoved = attrs.field(init=False)

    def __attrs_post_init__(self) -> None:
        context = host_context("leader", keys=lambda: self.keys)
        self.hand = HandMoved(HandMovedOptions(deadman=self.deadman), context, "leader arm", MOVED)
        self.hand.check()
        self.hand.connect()
        self.pressed.disarm(self.now_ns)
        self.hand.activate(self.now_ns)

    def tick(self, *, complete: bool = True, known: bool = True) -> TeleopCommand:
        self.now_ns += TICK_NS
        self.hand.take(self.now_ns)
        self.pressed.report(self.hand.engaged(self.device, complete=complete), self.now_ns)
        pose = self.device if known else None
        command = self.hand.command(self.pressed, ("pan", "tilt"), self.robot, pose, SPEED, self.now_ns)
        if command.positions is not None:
            self.robot = np.array([command.positions[name] for name in ("pan", "tilt")])
        return command

    def ticks(self, count: int) -> TeleopCommand:
        return [self.tick() for _ in range(count)][-1]


@pytest.mark.parametrize("deadman", ["toggle", "hold"])
def test_a_key_needs_a_terminal(deadman: str) -> None:
    hand = HandMoved(HandMovedOptions(deadman=deadman), host_context("leader"), "leader arm", MOVED)
    with pytest.raises(TeleopError, match=f"leader: deadman: {deadman} needs a terminal: .* once the leader arm is"):
        hand.check()
    HandMoved(HandMovedOptions(deadman="none"), host_context("leader"), "leader arm", MOVED).check()


def test_the_robot_approaches_the_pose_on_a_straight_way_and_then_follows_it() -> None:
    bench = Bench("toggle")
    assert bench.tick().positions is None
    assert bench.hand.help() == "PAUSED: press space to follow the leader arm"
    bench.keys.put("space")
    way = [bench.robot.copy()]
    while (command := bench.tick()).positions is None or command.approaching:
        way.append(bench.robot.copy())
        assert len(way) < 60
    steps = np.diff(way, axis=0)
    assert np.abs(steps).max() == pytest.approx(SPEED[0] * 0.02)
    np.testing.assert_allclose(steps[:, 1], -0.5 * steps[:, 0], atol=1e-12)  # both joints arrive together
    assert bench.hand.help() == "following the leader arm: space pauses"
    bench.device = np.array([-0.5, 0.5])
    assert bench.tick() == TeleopCommand({"pan": -0.5, "tilt": 0.5})
    bench.keys.put("space")
    assert bench.tick().positions is None
    bench.robot = np.zeros(2)
    bench.ticks(50)  # sooner, it could be a repeat of a held key
    bench.keys.put("space")
    assert bench.ticks(10).approaching, "each pause ends in an approach"
    assert np.abs(bench.robot).max() < 0.1


def test_a_held_key_moves_the_robot_until_it_is_released() -> None:
    bench = Bench("hold")
    bench.tick()
    for event in ("space", "repeat:space"):
        bench.keys.put(event)
    assert bench.tick().approaching
    assert bench.hand.help() == "following the leader arm: release space to pause"
    bench.keys.put("release:space")
    assert bench.tick().positions is None
    assert bench.hand.help() == "PAUSED: hold space to follow the leader arm"


def test_without_a_key_a_hand_must_move_the_device_from_where_it_rests() -> None:
    bench = Bench("none")
    bench.device = np.zeros(2)
    assert bench.tick(complete=False).positions is None
    bench.device = np.array([0.5, 0.0])  # the first whole reading: nobody has moved it
    assert bench.ticks(5).positions is None
    assert bench.hand.help() == "PAUSED: move the leader arm to start"
    bench.device = bench.device + 0.9 * MOVED
    assert bench.tick().positions is None
    bench.device = bench.device + 0.2 * MOVED
    assert bench.tick().approaching
    assert bench.hand.help() == "following the leader arm"


def test_the_robot_waits_while_the_pose_is_unknown_and_then_approaches_again() -> None:
    bench = Bench("none")
    bench.tick()
    bench.device = bench.device + 2 * MOVED
    assert not bench.ticks(60).approaching
    assert bench.tick(known=False).positions is None
    bench.device = bench.device - 0.5
    before = bench.robot.copy()
    assert bench.tick().approaching
    np.testing.assert_array_equal(bench.robot, before)  # it begins where the robot is


def test_a_mode_that_begins_again_needs_a_new_press() -> None:
    bench = Bench("toggle")
    bench.tick()
    bench.keys.put("space")
    assert bench.ticks(10).approaching
    bench.hand.activate(bench.now_ns)
    bench.pressed.disarm(bench.now_ns)
    assert bench.ticks(50).positions is None
    bench.keys.put("space")
    assert bench.ticks(10).approaching
