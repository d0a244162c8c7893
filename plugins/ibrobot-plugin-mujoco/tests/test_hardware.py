"""Simulated hardware: conformance, determinism, latency, noise, limits, relaxing, injected faults, time."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import Fault, MujocoOptions
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import stamp_of
from ibrobot_testing import SimulatedHardwareSuite, control_context

from ibrobot_core.api import Context, EpisodeSetup, Hardware, HardwareError, JointReading, Vector

ROBOT = so101()
REST = ROBOT.pose("rest")
MOVED = REST + np.array([0.4, 0.3, -0.3, -0.3, 0.5, 0.6])
TICK_NS = 10_000_000


class TestConformance(SimulatedHardwareSuite):
    reach = 0.3  # farther, the shoulder alone meets the table

    @override
    def context(self) -> Context:
        return control_context(robot=ROBOT)

    @override
    def make(self, ctx: Context) -> MujocoHardware:
        return MujocoHardware(MujocoOptions(), ctx)

    @override
    @staticmethod
    def _signals(hardware: Hardware) -> list[Vector]:
        values = SimulatedHardwareSuite._signals(hardware)
        values[0][:2] = 0  # the stamp, which goes on from run to run
        return values


class TestConformanceWithLatency(TestConformance):
    @override
    def make(self, ctx: Context) -> MujocoHardware:
        return MujocoHardware(MujocoOptions(latency=0.02, scene=scene("empty")), ctx)


class TestConformanceOfSomeJoints(TestConformance):
    """Only some of the joints, in another order than the model's."""

    @override
    def context(self) -> Context:
        return control_context(robot=ROBOT, joints=("gripper", "shoulder_pan", "wrist_roll"))


def connected(options: MujocoOptions, seed: int = 0, period_ns: int = TICK_NS) -> Rig:
    rig = Rig(options, period_ns)
    rig.hardware.reset(EpisodeSetup(seed))
    return rig


class Rig:
    """Connected hardware whose clock and physics advance together."""

    def __init__(self, options: MujocoOptions, period_ns: int) -> None:
        self.ctx = control_context("sim", robot=ROBOT, period_ns=period_ns)
        self.hardware = MujocoHardware(options, self.ctx)
        self.hardware.connect()

    def run(self, duration_s: float, command: Vector | None = None) -> list[JointReading]:
        """Readings of the ticks of `duration_s` [s]; `command` is written in the first."""
        if command is not None:
            self.hardware.write(command)
        readings = []
        for _ in range(round(duration_s * 1e9 / self.ctx.period_ns)):
            self.hardware.advance(self.ctx.period_ns)
            self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + self.ctx.period_ns)
            readings.append(self.hardware.read())
        return readings

    def signal(self, index: int) -> Vector:
        out = np.full(self.hardware.signals[index].size, np.nan)
        self.hardware.read_signal(index, out)
        return out


def positions(readings: list[JointReading]) -> Vector:
    return np.stack([reading.position for reading in readings])


@pytest.mark.parametrize("options", [MujocoOptions(), MujocoOptions(latency=0.013, noise=0.001)])
def test_equal_seeds_give_equal_bits_through_a_long_run(options: MujocoOptions) -> None:
    runs = []
    for _ in range(2):
        rig = connected(options, seed=5)
        readings = rig.run(1.0, MOVED) + rig.run(1.0, REST)
        runs.append((positions(readings), rig.signal(0)))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])


def test_starts_at_rest_in_the_start_pose() -> None:
    reading = connected(MujocoOptions(start_pose="home")).hardware.read()
    np.testing.assert_array_equal(reading.position, ROBOT.pose("home"))
    np.testing.assert_array_equal(reading.velocity, 0)


def test_holds_the_start_pose_against_gravity() -> None:
    np.testing.assert_allclose(positions(connected(MujocoOptions()).run(1.0)), np.tile(REST, (100, 1)), atol=0.01)


def test_unknown_start_pose_is_named() -> None:
    with pytest.raises(HardwareError, match=r"simulation\.start_pose: no pose 'yoga'; the poses are: home, rest"):
        MujocoHardware(MujocoOptions(start_pose="yoga"), control_context(robot=ROBOT))


def test_joints_come_in_the_order_asked_for() -> None:
    names = ("gripper", "elbow_flex")
    hardware = MujocoHardware(MujocoOptions(), control_context(robot=ROBOT, joints=names))
    hardware.connect()
    np.testing.assert_array_equal(hardware.read().position, REST[ROBOT.indices(names)])


def test_latency_delays_commands_and_readings() -> None:
    latency, ticks = 0.05, 5
    prompt, late = connected(MujocoOptions()), connected(MujocoOptions(latency=latency))
    for rig in (prompt, late):
        rig.run(1.0)  # what sags after the start has sagged
    before = prompt.hardware.read().position
    now, then = positions(prompt.run(0.5, MOVED)), positions(late.run(0.5, MOVED))
    np.testing.assert_allclose(then[: 2 * ticks], np.tile(before, (2 * ticks, 1)), atol=1e-4)
    np.testing.assert_allclose(then[2 * ticks :], now[: -2 * ticks], atol=1e-4)
    assert abs(then[2 * ticks + 2] - before).max() > 1e-3, "the command never arrived"


def test_latency_is_kept_finer_than_a_tick() -> None:
    whole, half = (connected(MujocoOptions(latency=latency)) for latency in (0.010, 0.006))
    first, second = positions(whole.run(0.2, MOVED)), positions(half.run(0.2, MOVED))
    assert (abs(second[3:10, 0]) > abs(first[3:10, 0])).all()


def test_noise_is_on_the_reading_alone() -> None:
    noise = 0.002
    clean, noisy = connected(MujocoOptions()), connected(MujocoOptions(noise=noise))
    deviation = positions(noisy.run(4.0)) - positions(clean.run(4.0))
    assert deviation.std() == pytest.approx(noise, rel=0.1)
    assert abs(deviation.mean()) < noise / 10
    np.testing.assert_array_equal(noisy.signal(0), clean.signal(0))


def test_torque_stays_within_its_limit() -> None:
    weak, stock = connected(MujocoOptions(torque_limit=0.3)), connected(MujocoOptions())
    efforts = [np.abs([r.effort for r in rig.run(0.5, MOVED)]).max() for rig in (weak, stock)]
    assert efforts[0] <= 0.3
    assert 0.3 < efforts[1] <= 2.94


def test_speed_stays_within_its_limit() -> None:
    limited = positions(connected(MujocoOptions(velocity_limit=0.5)).run(0.5, MOVED))
    assert limited[-1, 0] == pytest.approx(0.5 * 0.5, abs=0.03)
    assert positions(connected(MujocoOptions()).run(0.5, MOVED))[-1, 0] == pytest.approx(0.4, abs=0.02)


def test_relaxed_arm_falls_until_the_next_command() -> None:
    rig = connected(MujocoOptions(scene=scene("empty"), start_pose="home"))
    rig.hardware.relax()
    fallen = rig.run(1.0)
    np.testing.assert_array_equal(fallen[-1].effort, 0)
    assert abs(fallen[-1].position).max() > 0.3
    held = fallen[-1].position
    back = positions(rig.run(1.0, held))
    np.testing.assert_allclose(back, np.tile(held, (100, 1)), atol=0.05, err_msg="torque came back with a jump")


def test_relaxing_ends_with_the_episode() -> None:
    rig = connected(MujocoOptions())
    rig.hardware.relax()
    rig.run(0.1)
    rig.hardware.reset(EpisodeSetup(0))
    np.testing.assert_allclose(rig.run(0.5)[-1].position, REST, atol=0.01)


@pytest.mark.parametrize("command", [np.array([np.nan, 0, 0, 0, 0, 0]), np.zeros(5), np.zeros((6, 1))])
def test_malformed_commands_are_refused(command: Vector) -> None:
    with pytest.raises(HardwareError, match="sim: a command is 6 finite angles"):
        connected(MujocoOptions()).hardware.write(command)


def test_frozen_joint_ignores_commands_for_as_long_as_the_fault_lasts() -> None:
    rig = connected(MujocoOptions(faults=(Fault(at=0.1, kind="freeze_joint", joint="shoulder_pan", duration=0.5),)))
    rig.run(0.1)
    stuck = rig.run(0.4, MOVED)[-1].position
    assert stuck[0] == pytest.approx(REST[0], abs=0.01)
    np.testing.assert_allclose(stuck[1:5], MOVED[1:5], atol=0.03)
    rig.run(0.1)
    assert rig.run(0.5, MOVED)[-1].position[0] == pytest.approx(MOVED[0], abs=0.02)


def test_silence_repeats_the_last_reading_and_loses_commands() -> None:
    rig = connected(MujocoOptions(faults=(Fault(at=0.1, kind="silent", duration=0.2),)))
    last = rig.run(0.09)[-1]
    silent = rig.run(0.2, None)
    for reading in silent:
        assert reading.stale
        assert reading.stamp_ns == last.stamp_ns
        np.testing.assert_array_equal(reading.position, last.position)
    fresh = rig.run(0.1)[-1]
    assert not fresh.stale
    assert fresh.stamp_ns == rig.ctx.clock.now_ns()


def test_commands_are_lost_in_silence() -> None:
    rig = connected(MujocoOptions(faults=(Fault(at=0.0, kind="silent", duration=0.1),)))
    rig.hardware.write(MOVED)
    with pytest.raises(HardwareError, match="sim: no joint has ever answered"):
        rig.hardware.read()
    rig.hardware.advance(200_000_000)
    np.testing.assert_allclose(rig.hardware.read().position, REST, atol=0.01)


def test_read_errors_last_until_faults_are_reset() -> None:
    rig = connected(MujocoOptions(faults=(Fault(at=0.05, kind="read_error"),)))
    rig.run(0.04)
    for _ in range(3):
        with pytest.raises(HardwareError, match=r"sim: reading failed \(injected fault read_error\)"):
            rig.run(0.01)
    rig.hardware.reset_faults()
    assert not rig.run(1.0)[-1].stale
    rig.hardware.reset(EpisodeSetup(0))
    with pytest.raises(HardwareError, match="injected"):
        rig.run(0.1)


def test_resetting_faults_leaves_those_that_are_still_to_come() -> None:
    rig = connected(MujocoOptions(faults=(Fault(at=0.05, kind="read_error"),)))
    rig.hardware.reset_faults()
    with pytest.raises(HardwareError, match="injected"):
        rig.run(0.1)


def test_a_fault_of_an_unknown_joint_is_named() -> None:
    options = MujocoOptions(faults=(Fault(at=0.0, kind="freeze_joint", joint="knee"),))
    with pytest.raises(HardwareError, match=r"simulation\.faults: no joint 'knee'; the joints are: shoulder_pan, "):
        MujocoHardware(options, control_context(robot=ROBOT))


def test_time_does_not_drift_when_ticks_are_no_multiple_of_the_timestep() -> None:
    # 300 ticks of a third of 10 ms, 3 ms a step: neither divides the other.
    odd = connected(MujocoOptions(timestep=0.003), period_ns=3_333_333)
    even = connected(MujocoOptions(timestep=0.003), period_ns=3_000_000)
    odd.run(300 * 3_333_333 / 1e9, MOVED)
    even.run(333 * 0.003, MOVED)
    np.testing.assert_array_equal(odd.signal(0)[2:], even.signal(0)[2:])


def test_physics_signal_carries_the_stamp_of_the_reading() -> None:
    rig = connected(MujocoOptions())
    reading = rig.run(0.05)[-1]
    assert stamp_of(rig.signal(0)) == reading.stamp_ns
    rig.hardware.advance(TICK_NS)
    assert stamp_of(rig.signal(0)) == reading.stamp_ns + TICK_NS


def test_the_empty_scene_has_no_task() -> None:
    hardware = connected(MujocoOptions(scene=scene("empty"))).hardware
    assert [signal.topic for signal in hardware.signals] == ["/simulation/physics"]
    assert hardware.success() is None


def test_ground_truth_names_cube_and_bin() -> None:
    rig = connected(MujocoOptions(scene=scene(bin_position=(0.12, 0.22))))
    truth = rig.signal(1)
    assert 0.20 <= np.linalg.norm(truth[:2]) <= 0.27
    assert np.linalg.norm(truth[3:7]) == pytest.approx(1)
    np.testing.assert_allclose(truth[7:], [0.12, 0.22, 0.025])


def test_seed_of_the_context_sets_the_first_scene() -> None:
    scenes = []
    for seed in (3, 3, 4):
        hardware = MujocoHardware(MujocoOptions(), attrs.evolve(control_context(robot=ROBOT), seed=seed))
        hardware.connect()
        scenes.append(np.empty(10))
        hardware.read_signal(1, scenes[-1])
    np.testing.assert_array_equal(scenes[0], scenes[1])
    assert (scenes[0][:2] != scenes[2][:2]).all()
