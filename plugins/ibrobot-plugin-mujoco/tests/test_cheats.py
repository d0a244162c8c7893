"""Policies that reach the end of a task by another way than the task: no scene takes them for a success."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Sequence
from typing import Any, ClassVar, override

import mujoco
import numpy as np
import pytest
from ibrobot_mujoco.experts.expert import SCENE, STATE, ScriptedExpert
from ibrobot_mujoco.experts.handover import HandoverTask
from ibrobot_mujoco.experts.options import ExpertOptions
from ibrobot_mujoco.experts.pick_cube import PickTask
from ibrobot_mujoco.experts.push import PushTask
from ibrobot_mujoco.experts.task import Task
from ibrobot_mujoco.experts.way import GRASP_TURN_RAD, HOVER_TURN_RAD, SETTLE_S, UP, Way, axes_of, down
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes import handover, scene
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import SCENE_TOPIC

from ibrobot_core.api import NS_PER_S, Context, EpisodeSetup, Frame, Robot, SteppedClock, Vector

from . import test_scenes
from .test_scenes import begun, carry, put, two_arms

PERIOD_NS, CHUNK_TICKS = 10_000_000, 3


class OneHandTask(Task):
    """The right arm picks the bar up and carries it to the end, while the left one stands still."""

    sides: ClassVar[tuple[str, ...]] = ("left_", "right_")

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        right, options = self.hands[1], self.options
        axis = axes_of(scene[:7])[:, 1]
        grip = scene[:3] - 0.055 * axis * np.sign(axis[1])
        heading = float(np.arctan2(axis[1], axis[0])) - np.pi / 2
        heading += np.pi * round((right.inward(grip) - heading) / np.pi)
        opened, closed = options.gripper_open, options.gripper_closed
        hover = right.reach(grip + options.hover_height * UP, down(heading), way.at, opened, HOVER_TURN_RAD)
        grasp = right.reach(grip, down(heading), hover, opened, GRASP_TURN_RAD)
        way.grasp(right, hover, grasp, closed, lambda state, seen: True)
        lifted, end = right.grip(hover, closed), np.array([0.19, -0.2, 0.13])
        way.to("lift", lifted)
        way.to("carry", right.reach(end, down(right.inward(end)), lifted, closed, HOVER_TURN_RAD))
        way.rest("return", SETTLE_S)


class CarryTask(PickTask):
    """Carries the block to the mark."""

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        self.deliver(way, 0, scene[:7], scene[7:10] - 0.02 * UP)
        way.to("return", home)


def run(type_: str, robot: Robot, task: type[Task], seed: int, seconds: float, **options: Any) -> tuple[bool, Vector]:
    """Run a policy; whether it ever succeeded, and the ground truth at the end."""
    clock = SteppedClock(NS_PER_S)
    ctx = Context("cheat", clock, logging.getLogger("ibrobot.test"), robot, robot.joint_names, PERIOD_NS)
    hardware = MujocoHardware(MujocoOptions(scene=scene(type_, **options)), ctx)
    hardware.connect()
    index, signal = next((i, s) for i, s in enumerate(hardware.signals) if s.topic == SCENE_TOPIC)
    policy = ScriptedExpert(task, "cheat", ExpertOptions(), ctx, signal.size)
    policy.load()
    hardware.reset(EpisodeSetup(seed))
    policy.reset(seed)
    seen, won = np.empty(signal.size), False
    for tick in range(round(seconds * NS_PER_S / PERIOD_NS)):
        state = hardware.read().position
        hardware.read_signal(index, seen)
        if tick % CHUNK_TICKS == 0:
            values = {STATE: state.astype(np.float32), SCENE: seen.astype(np.float32)}
            actions = policy.postprocess(policy.infer(policy.preprocess(Frame(clock.now_ns(), values))))
        won |= bool(hardware.success())
        hardware.write(actions[0])
        hardware.advance(PERIOD_NS)
        clock.advance(PERIOD_NS)
    hardware.disconnect()
    return won, seen


@pytest.mark.parametrize("seed", range(2))
def test_right_arm_alone_hands_nothing_over(seed: int) -> None:
    won, seen = run("handover", two_arms(), OneHandTask, seed, 7.0, bar_y=(-0.02, 0.02))
    assert seen[2] > 0.05, "it lifts the bar"
    assert seen[1] < -0.05, "on its own side"
    assert not won


def test_handed_over_bar_is_a_success() -> None:
    assert run("handover", two_arms(), HandoverTask, 0, 14.0)[0]


def test_carried_block_is_not_pushed() -> None:
    won, seen = run("push", so101(), CarryTask, 0, 7.0, block_size=0.025, goal_tolerance=0.05)
    assert np.hypot(*(seen[:2] - seen[7:9])) < 0.05, "it lies on the mark"
    assert not won


def test_pushed_block_is_a_success() -> None:
    assert run("push", so101(), PushTask, 0, 8.0)[0]


HOLDERS = {
    "L": ("left", "left jaw"),
    "R": ("right", "right jaw"),
    "B": ("left", "left jaw", "right", "right jaw"),
    "T": ("right", "right jaw", "table"),
    "M": ("left", "left jaw", "right"),
    "E": ("right", "right jaw", "right link"),
    "A": (),
}
"""Who touches the bar: the left hand, the right one, both, the right one on the table, the left one and a jaw of the
right one, the right one at a link, nobody."""
HANDED_OVER = re.compile(r"(?:.*[TA])?[LRBEM]*LM*B[RBEM]*R")


@pytest.mark.parametrize("holders", [3, pytest.param(4, marks=pytest.mark.long)])
def test_every_sequence_of_holders(monkeypatch: pytest.MonkeyPatch, holders: int) -> None:
    """The bar ends in the right place in each."""
    suite = test_scenes.TestHandover()  # its tests are not collected here again
    made = suite.make(suite.context())
    world = suite.world(made, suite.context())
    assert isinstance(made, handover.Handover)
    left, right = made._jaws_of(world)
    bodies = {
        "left": {max(left)}, "left jaw": {min(left)}, "right": {max(right)}, "right jaw": {min(right)},
        "right link": {world.model.body("right_upper_arm").id}, "table": {0},
    }  # fmt: skip
    now: set[int] = set()
    monkeypatch.setattr(handover, "touching", lambda world, body: set(now))
    monkeypatch.setattr("ibrobot_mujoco.scenes.table.touching", lambda world, body: set(now))
    won = 0
    for sequence in itertools.product(HOLDERS, repeat=holders):
        suite.begin(made, world, 0)
        put(world, "bar", (0.19, -0.2, 0.13))
        for holder in sequence:
            now = set().union(*(bodies[each] for each in HOLDERS[holder]))
            found = made.success(world)
        text = "".join(sequence)
        assert found is bool(HANDED_OVER.fullmatch(text)), text
        won += found
    assert 0 < won < 20


def ends(type_: str) -> tuple[Any, Any, Sequence[tuple[str, tuple[float, float, float]]]]:
    """A scene, with the places of its bodies at the end of the task."""
    world, made = begun(type_, seed=1)
    out = np.empty(len(made.values))
    made.observe(world, out)
    if type_ == "pick_cube":
        return world, made, [("cube", (*out[7:9], 0.017))]
    if type_ == "stack":
        x, y, z = world.pose("base_cube")[:3]
        return world, made, [("cube", (x, y, z + 0.0275))]
    centres = out[24:].reshape(2, 3)
    spots = [(centres[int(n)][0], centres[int(n)][1] + 0.03 * (i - 1), 0.017) for i, n in enumerate(out[21:24])]
    return world, made, [(f"cube{i + 1}", spot) for i, spot in enumerate(spots)]


@pytest.mark.parametrize("type_", ["pick_cube", "stack", "sort"])
@pytest.mark.parametrize("way", ["never touched", "hit", "thrown", "carried", "carried in another episode"])
def test_only_what_was_carried_counts(type_: str, way: str) -> None:
    world, made, places = ends(type_)
    for body, place in places:
        if way == "hit":  # the hand touches it, and so does the table
            x, y, _ = world.data.site("gripperframe").xpos
            put(world, body, (x, y, 0.0125))
        elif way == "thrown":
            put(world, body, (0.25, 0.0, 0.2))
        elif way.startswith("carried"):
            carry(world, made, body)
        made.success(world)
        put(world, body, place)
    if way == "carried in another episode":
        _, _, places = ends(type_)
        made.begin(world, np.random.default_rng(1))
        for body, place in places:
            put(world, body, place)
    mujoco.mj_forward(world.model, world.data)
    assert made.success(world) is (way == "carried")


def test_drawer_that_nobody_touched_is_not_opened() -> None:
    world, made = begun("drawer")
    world.data.joint("drawer").qpos = 0.09
    mujoco.mj_forward(world.model, world.data)
    assert not made.success(world)


@pytest.mark.parametrize(("beside", "expected"), [(False, False), (True, True)])
def test_lifted_block_has_to_be_pushed_from_beside_the_mark(beside: bool, expected: bool) -> None:
    world, made = begun("push")
    x, y, _ = world.data.mocap_pos[0]
    put(world, "block", (x - 0.1, y, 0.1))
    assert not made.success(world)
    if beside:
        put(world, "block", (x - 0.1, y, 0.0175))
        assert not made.success(world)
    put(world, "block", (x, y, 0.0175))
    assert made.success(world) is expected
