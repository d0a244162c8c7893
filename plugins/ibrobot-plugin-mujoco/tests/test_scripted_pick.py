"""The scripted pick: succeeds within all limits, in chunks that agree, and tries again where something went wrong."""

from __future__ import annotations

from itertools import pairwise
from typing import override

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_kinematics import robot_model
from ibrobot_mujoco.experts import EXPERTS
from ibrobot_mujoco.experts.expert import SCENE, STATE
from ibrobot_mujoco.experts.options import ExpertOptions
from ibrobot_mujoco.options import Fault, MujocoOptions
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import PolicySuite, host_context

from ibrobot_core.api import Context, Frame, Policy, PolicyError, Vector, ns, seconds

from .pick_loop import PERIOD_NS, RATE_HZ, Outcome, PickLoop

ROBOT = so101()
CUBE = (0.24, 0.03, 0.0125)
BIN = (0.10, 0.24, 0.025)


def scripted_pick(ctx: Context) -> Policy:
    return EXPERTS[0].make(ExpertOptions(), ctx)


def frame(time_s: float, cube: tuple[float, float, float] = CUBE, state: Vector | None = None) -> Frame:
    scene = np.array([*cube, 1, 0, 0, 0, *BIN], dtype=np.float32)
    position = ROBOT.pose("rest") if state is None else state
    return Frame(ns(100 + time_s), {STATE: position.astype(np.float32), SCENE: scene})


def chunk(policy: Policy, *args: object) -> Vector:
    return policy.postprocess(policy.infer(policy.preprocess(frame(*args))))  # type: ignore[arg-type]


@pytest.fixture
def policy() -> Policy:
    made = scripted_pick(host_context(robot=ROBOT))
    made.load()
    made.reset(0)
    return made


@pytest.fixture(scope="module")
def loop() -> PickLoop:
    return PickLoop()


def assert_chunks_agree(outcome: Outcome) -> None:
    for (earlier_s, earlier), (later_s, later) in pairwise(outcome.chunks):
        shift = round(later_s * RATE_HZ) - round(earlier_s * RATE_HZ)
        assert 0 < shift < len(earlier)
        np.testing.assert_allclose(later[: len(earlier) - shift], earlier[shift:], rtol=0, atol=1e-12)


def assert_within_limits(outcome: Outcome) -> None:
    commands, period_s = np.array(outcome.commands), seconds(PERIOD_NS)
    velocity = np.diff(commands, axis=0) / period_s
    assert np.all(commands >= ROBOT.lower)
    assert np.all(commands <= ROBOT.upper)
    assert np.all(np.abs(velocity) <= ROBOT.max_velocity)
    assert np.all(np.abs(np.diff(velocity, axis=0)) / period_s <= ROBOT.max_acceleration)


class TestConformance(PolicySuite):
    ignores = frozenset({"observation.state"})  # it knows the scene, and begins at its rest pose

    @override
    def make(self, ctx: Context) -> Policy:
        return scripted_pick(ctx)

    @override
    def context(self) -> Context:
        return host_context(robot=ROBOT)

    @override
    def frame(self, policy: object, ctx: Context, seed: int) -> Frame:
        bearing = -0.5 + 0.3 * (seed % 4)
        cube = (0.23 * np.cos(bearing), 0.23 * np.sin(bearing), 0.0125)
        return attrs.evolve(frame(0.0, cube), stamp_ns=ctx.clock.now_ns())


@pytest.mark.parametrize("seed", range(8))
def test_puts_the_cube_into_the_bin(loop: PickLoop, seed: int) -> None:
    outcome = loop.run(seed)
    assert outcome.success
    assert outcome.interventions == {}
    assert outcome.bumps == set()
    assert_within_limits(outcome)
    assert_chunks_agree(outcome)


def test_begins_from_home_as_well() -> None:
    outcome = PickLoop(MujocoOptions(start_pose="home")).run(3)
    assert outcome.success
    assert outcome.interventions == {}
    assert outcome.bumps == set()


def test_tries_again_when_the_gripper_did_not_close() -> None:
    loop = PickLoop(MujocoOptions(faults=(Fault(at=1.5, kind="freeze_joint", joint="gripper", duration=3.0),)))
    outcome = loop.run(1, 13.0)
    assert outcome.success
    assert outcome.success_s is not None
    assert outcome.success_s > 7.0, "the first attempt succeeded: the fault came to nothing"
    assert outcome.interventions["lead"] > 0, "the setpoint ran away from the gripper that did not move"
    assert outcome.bumps == set()
    assert_chunks_agree(outcome)


def test_equal_seeds_give_equal_commands(loop: PickLoop) -> None:
    first = loop.run(5, 3.0)
    loop.run(6, 1.0)
    again = loop.run(5, 3.0)
    np.testing.assert_array_equal(first.commands, again.commands)


def test_rests_where_it_is_then_moves_and_ends_where_it_began(policy: Policy) -> None:
    first = chunk(policy, 0.0)
    rest = ROBOT.pose("rest").astype(np.float32).astype(np.float64)
    np.testing.assert_array_equal(first[:6], np.tile(rest, (6, 1)))
    assert np.abs(first[-1] - rest).max() > 0.5
    np.testing.assert_allclose(chunk(policy, 60.0, BIN), np.tile(rest, (50, 1)), atol=1e-12)


@pytest.mark.parametrize("jitter_s", [-0.016, 0.0, 0.009, 0.016])
def test_chunks_agree_whatever_the_jitter_of_the_stamps(policy: Policy, jitter_s: float) -> None:
    first = chunk(policy, 0.0)
    np.testing.assert_array_equal(chunk(policy, 30 / RATE_HZ + jitter_s)[:20], first[30:])


def test_a_cube_pushed_away_is_followed_from_where_it_is_clear(policy: Policy) -> None:
    undisturbed = [chunk(policy, float(second)) for second in range(4)]
    policy.reset(0)
    pushed = [chunk(policy, 0.0), *(chunk(policy, float(second), (0.20, -0.12, 0.0125)) for second in range(1, 6))]
    for earlier, later in pairwise(pushed):
        np.testing.assert_allclose(later[:20], earlier[30:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(pushed[1], undisturbed[1])  # down, closed on nothing, and up again
    assert np.abs(pushed[3] - undisturbed[3]).max() > 0.2
    tip = robot_model(ROBOT).forward
    there = [tip(action).position for action in pushed[5]]
    assert min(np.linalg.norm(position - (0.20, -0.12, 0.0125)) for position in there) < 0.002


def test_a_cube_taken_out_again_is_picked_again(policy: Policy) -> None:
    chunk(policy, 0.0)
    held, taken = chunk(policy, 60.0, BIN), [chunk(policy, 61.0 + second) for second in range(3)]
    np.testing.assert_allclose(taken[0][:20], held[30:], rtol=0, atol=1e-12)
    way = np.concatenate([held[:30], *(each[:30] for each in taken)])
    assert np.abs(np.diff(way, axis=0)).max() < 4.0 / RATE_HZ
    assert np.abs(np.diff(way, 2, axis=0)).max() < 40.0 / RATE_HZ**2
    assert np.abs(way[-1] - held[0]).max() > 0.5


def test_a_cube_lost_on_the_way_is_not_carried_on(policy: Policy) -> None:
    ends = []
    for lost in (False, True):
        policy.reset(0)
        chunks = [chunk(policy, float(second)) for second in range(4)]
        on_the_way = chunks[-1][20]
        cube = CUBE if lost else tuple(robot_model(ROBOT).forward(on_the_way).position)
        ends.append(chunk(policy, 3.0 + 20 / RATE_HZ, cube, on_the_way))
    np.testing.assert_allclose(ends[1][:20], ends[0][:20], rtol=0, atol=1e-12)
    assert np.abs(ends[1][-1] - ends[0][-1]).max() > 0.1


def test_jaws_close_on_faces_whichever_face_the_cube_lies_on(policy: Policy) -> None:
    half = np.pi / 4
    yaw = np.array([np.cos(0.15), 0, 0, np.sin(0.15)])
    ways = []
    for roll in ([1, 0, 0, 0], [np.cos(half), np.sin(half), 0, 0], [np.cos(half), 0, np.sin(half), 0], [0, 1, 0, 0]):
        lying = np.empty(4)
        mujoco.mju_mulQuat(lying, yaw, np.array(roll, dtype=float))
        seen = frame(0.0)
        scene = np.array([*CUBE, *lying, *BIN])
        policy.reset(0)
        tensors = policy.preprocess(attrs.evolve(seen, values={**seen.values, SCENE: scene}))
        ways.append(policy.postprocess(policy.infer(tensors)))
    for way in ways[1:]:
        np.testing.assert_allclose(way, ways[0], atol=1e-6)
    policy.reset(0)
    assert np.abs(chunk(policy, 0.0)[-1] - ways[0][-1])[4] > 0.2, "the wrist does not turn with the cube"


def test_a_reset_forgets_the_episode(policy: Policy) -> None:
    first = chunk(policy, 0.0)
    chunk(policy, 1.0)
    policy.reset(0)
    np.testing.assert_array_equal(chunk(policy, 7.0), first)


def test_a_cube_out_of_reach_is_named(policy: Policy) -> None:
    message = r"scripted_pick cannot plan its task: gripperframe cannot reach \(0.600, 0.000, 0.083\) m"
    with pytest.raises(PolicyError, match=message):
        chunk(policy, 0.0, (0.6, 0.0, 0.0125))


def test_a_frame_that_is_not_finite_is_refused(policy: Policy) -> None:
    with pytest.raises(PolicyError, match=r"needs observation.environment_state with 10 finite numbers, got \[nan"):
        policy.preprocess(frame(0.0, (np.nan, 0.0, 0.0)))


def test_a_vector_of_another_length_is_refused(policy: Policy) -> None:
    with pytest.raises(PolicyError, match=r"needs observation.state with 6 finite numbers, got \[0.0, 0.0\]"):
        policy.preprocess(frame(0.0, state=np.zeros(2)))


@pytest.mark.parametrize("wrong", [None, np.zeros(3), np.full(6, np.nan)], ids=["none", "shape", "nan"])
def test_a_request_with_other_tensors_is_refused_and_nothing_forgotten(policy: Policy, wrong: Vector | None) -> None:
    first = chunk(policy, 0.0)
    tensors = dict(policy.preprocess(frame(1.0)))
    policy.check(tensors)
    tensors.pop(STATE)
    if wrong is not None:
        tensors[STATE] = wrong
    for refuse in (policy.check, policy.infer):
        with pytest.raises(PolicyError, match=r"needs observation\.state with 6 finite numbers, got"):
            refuse(tensors)
    np.testing.assert_allclose(chunk(policy, 0.0), first)


def test_infer_before_load_is_refused() -> None:
    policy = scripted_pick(host_context(robot=ROBOT))
    with pytest.raises(PolicyError, match="is not loaded"):
        chunk(policy, 0.0)


def test_a_robot_without_a_gripper_is_refused() -> None:
    robot = attrs.evolve(ROBOT, groups={"arm": ROBOT.joint_names})
    with pytest.raises(PolicyError, match=r"one joint in robot.groups.gripper, got \[\]"):
        scripted_pick(host_context(robot=robot))


def test_a_robot_without_a_model_is_refused() -> None:
    robot = attrs.evolve(ROBOT, description=attrs.evolve(ROBOT.description, mjcf=None))
    with pytest.raises(PolicyError, match=r"cannot be loaded: robot 'so101' has no robot\.description\.mjcf"):
        scripted_pick(host_context(robot=robot)).load()
