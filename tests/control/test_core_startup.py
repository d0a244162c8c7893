"""The control loop's work, tick by tick: how the robot goes to its startup pose before its mode begins."""

from __future__ import annotations

import numpy as np
import pytest

from ibrobot_core.api import SlowDown
from ibrobot_core.control.commands import BeginStartup, EmergencyStop, SendGoal
from ibrobot_core.errors import HardwareError

REST = [-0.8, 1.0, 0.1]


def start(make_rig, **control: str | float):
    """Start, without a tick."""
    rig = make_rig({"control": {"startup": "pose rest", **control}})
    rig.core.start("stream")
    assert "error" not in rig.call(BeginStartup())
    rig.hardware.written.append(rig.hardware.read().position)
    return rig


@pytest.fixture
def rig(make_rig):
    return start(make_rig)


def arrive(rig, longest: int = 1100) -> None:
    """Tick until the robot is in its mode."""
    for _ in range(longest):
        if rig.core.arrived():
            return
        rig.tick()
    raise AssertionError(f"it has not arrived after {longest} ticks")


def test_it_arrives_slowly_and_then_the_mode_begins_from_there(rig):
    rig.tick()
    rig.plan([0.9, 0.0, 0.9], 0.1)
    arrive(rig)

    np.testing.assert_allclose(rig.core.state.command, REST, atol=1e-4)
    assert np.abs(np.diff(rig.hardware.written, axis=0)).max() <= 0.25 * 3.0 * 0.01 * (1 + 1e-9)
    rig.assert_within_limits()
    assert rig.interventions == 0
    rig.plan([-0.7, 0.9, 0.2])
    np.testing.assert_allclose(rig.tick(60).command, [-0.7, 0.9, 0.2])


def test_it_waits_until_everything_is_there_that_may_stop_it(make_rig):
    rig = make_rig({"control": {"startup": "pose rest"}})
    rig.core.start("stream")
    held = rig.tick().command
    np.testing.assert_array_equal(rig.tick(100).command, held)
    assert not rig.core.arrived()
    rig.core.begin_startup()
    arrive(rig)
    held = rig.tick(50).command
    rig.call(BeginStartup())  # too late to mean anything
    np.testing.assert_array_equal(rig.tick(20).command, held)


def test_the_mode_begins_from_a_new_reading_after_lost_replies(make_rig):
    rig = start(make_rig, state_timeout=2.0)
    while np.abs(rig.tick().position - REST).max() > 0.1:
        pass
    rig.hardware.stale = True
    rig.tick(50)
    assert not rig.core.arrived()
    rig.hardware.stale = False
    arrive(rig)
    np.testing.assert_allclose(rig.tick(20).command, REST, atol=0.01)


def test_hold_is_in_its_mode_at_once(make_rig):
    rig = make_rig({}).start()
    assert rig.core.arrived()


def test_a_joint_that_is_blocked_is_named(rig):
    rig.tick()
    blocked = rig.hardware.written[0][1]
    follow = type(rig.hardware).read

    def read():
        reading = follow(rig.hardware)
        reading.position[1] = blocked
        return reading

    rig.hardware.read = read
    with pytest.raises(
        HardwareError, match=r"control.startup: pose rest: joint lift does not follow: it is \d\.\d\d rad"
    ):
        arrive(rig)
    refused = rig.call(SendGoal(executor="arm_position", goal_id="1", goal=SlowDown()))["error"]
    assert refused == "refused after the start has failed"


def test_a_joint_that_hangs_too_far_from_the_pose_is_named(rig):
    rig.tick()
    follow = type(rig.hardware).read

    def read():
        reading = follow(rig.hardware)
        reading.position[1] -= 0.22
        return reading

    rig.hardware.read = read
    with pytest.raises(
        HardwareError, match=r"control.startup: pose rest: not reached within 10 s: lift is 0\.22 rad away; check"
    ):
        arrive(rig)


def test_a_fault_on_the_way_is_reported(rig):
    rig.tick(20)
    rig.hardware.silent = True
    rig.tick()
    with pytest.raises(HardwareError, match=r"control.startup: pose rest: .*the bus is silent"):
        arrive(rig, 10)
    assert_at_rest(rig)


@pytest.mark.parametrize("stop", ["hold", "relax"])
def test_a_stop_on_the_way_ends_it(make_rig, stop):
    rig = start(make_rig, stop=stop)
    rig.tick(20)
    assert rig.stop() <= 10
    assert rig.hardware.relaxed == (stop == "relax")
    assert np.abs(rig.core.state.command - REST).max() > 0.1
    rig.assert_within_limits()


def test_a_start_waits_for_joints_that_answer_late(make_rig, monkeypatch):
    rig = make_rig({})
    hardware = rig.hardware
    read, readings = hardware.read, iter(range(100))

    def late():
        hardware.stale = next(readings) < 50
        return read()

    monkeypatch.setattr(hardware, "read", late)
    rig.core.start("stream")
    assert rig.core.arrived()


def assert_at_rest(rig) -> None:
    """The last command moved no joint, and nothing before it broke a limit."""
    np.testing.assert_array_equal(rig.hardware.written[-1], rig.hardware.written[-2])
    rig.assert_within_limits()


@pytest.mark.parametrize("stop", ["hold", "pose rest"])
def test_a_stop_on_the_way_brakes_before_the_start_fails(make_rig, stop):
    rig = start(make_rig, stop=stop)
    rig.tick(20)
    assert np.abs(rig.hardware.written[-1] - rig.hardware.written[-2]).max() > 0.004
    assert rig.call(EmergencyStop())["stops"] == 1
    with pytest.raises(HardwareError, match=r"control\.startup: pose rest: emergency stop"):
        arrive(rig, 20)

    assert_at_rest(rig)


def test_a_pose_that_is_late_brakes_before_the_start_fails(make_rig):
    joints = [
        {"name": name, "lower": -1.5, "upper": 1.5, "max_velocity": 0.3, "max_acceleration": 1.0}
        for name in ("pan", "lift", "grip")
    ]
    rig = make_rig({"robot": make_rig({}).config.document["robot"] | {"joints": joints}, **STARTS_AT_REST})
    rig.core.start("stream")
    rig.core.begin_startup()
    with pytest.raises(HardwareError, match="not reached within 10 s"):
        arrive(rig)

    np.testing.assert_array_equal(rig.hardware.written[-1], rig.hardware.written[-2])


STARTS_AT_REST = {"control": {"startup": "pose rest"}}
