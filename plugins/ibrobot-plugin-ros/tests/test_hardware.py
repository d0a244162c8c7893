"""Hardware of type ros2_control, with a fake in place of ROS."""

from __future__ import annotations

import time

import attrs
import numpy as np
import pytest
from ibrobot_ros.hardware import Ros2Control
from ibrobot_ros.options import Ros2ControlOptions
from ibrobot_ros2 import encode
from ibrobot_testing.contexts import control_context
from ibrobot_testing.hardware import HardwareSuite

from ibrobot_core.api import HardwareError, Header, JointState, JointTrajectory, RealClock

from . import fake_node


def context():
    return attrs.evolve(control_context(), clock=RealClock())


class TestRos2Control(HardwareSuite):
    settle_s = 0.3

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def context(self):
        return context()

    def make(self, ctx):
        text = encode(JointState(Header(1), ctx.joints, np.full(len(ctx.joints), 7.5))).tobytes()
        begin = text.index(np.full(len(ctx.joints), 7.5).tobytes())
        state = text.replace(np.full(len(ctx.joints), 7.5).tobytes(), np.full(len(ctx.joints), 0.1).tobytes())
        python = fake_node.write(self.folder, f"controller {state.hex()} {begin} {len(ctx.joints)}")
        return Ros2Control(Ros2ControlOptions(controller="arm", python=str(python), stamp="receive"), ctx)

    def elapse(self, hardware, ctx, duration_s):
        ctx.clock.sleep_until(ctx.clock.now_ns() + max(ctx.period_ns, int(duration_s * 1e9)))


@pytest.fixture
def make(tmp_path):
    """Makes hardware whose node sends frames once it is there."""
    made = []

    def make(*frames, later=(), **options):
        ctx = context()
        python = fake_node.write(tmp_path, fake_node.sends(subscriber=list(frames), message=list(later)))
        hardware = Ros2Control(Ros2ControlOptions(controller="arm", python=str(python), **options), ctx)
        made.append(hardware)
        return hardware, ctx

    yield make
    for hardware in made:
        hardware.disconnect()


MATCHED = ({"op": "matched", "topic": "/arm/commands", "subscribers": 1}, b"")


def state(ctx, stamp_ns=None, **changes):
    fields = {"position": np.full(len(ctx.joints), 0.2), "name": ctx.joints, **changes}
    at = ctx.clock.now_ns() if stamp_ns is None else stamp_ns
    return ({"op": "message", "topic": "/joint_states"}, encode(JointState(Header(at), **fields)).tobytes())


def until_fault(hardware):
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        hardware.read()
        time.sleep(0.002)


def test_joints_are_found_by_name(make):
    names = (*reversed(context().joints), "other")
    _, ctx = make()
    hardware, ctx = make(MATCHED, state(ctx, name=names, position=np.arange(len(names), dtype=float)), stamp="receive")
    hardware.connect()
    np.testing.assert_array_equal(hardware.read().position, np.arange(len(ctx.joints))[::-1])


def test_a_tick_without_a_state_is_stale(make):
    _, ctx = make()
    hardware, _ = make(MATCHED, state(ctx), stamp="receive")
    hardware.connect()
    readings = [hardware.read() for _ in range(3)]
    assert readings[-1].stale
    assert hardware.counters()["silent_ticks"] >= 2


def test_states_with_stamps_of_another_clock_are_refused(make):
    _, ctx = make()
    hardware, _ = make(MATCHED, state(ctx, 17))
    with pytest.raises(HardwareError, match="set stamp: receive"):
        hardware.connect()


def test_positions_that_are_no_numbers_are_a_fault(make):
    _, ctx = make()
    hardware, _ = make(MATCHED, state(ctx, position=np.full(len(ctx.joints), np.nan)), stamp="receive")
    with pytest.raises(HardwareError, match="is not a number"):
        hardware.connect()


def test_a_controller_that_goes_is_a_fault(make):
    _, ctx = make()
    gone = ({"op": "matched", "topic": "/arm/commands", "subscribers": 0}, b"")
    hardware, _ = make(MATCHED, state(ctx), later=[gone], stamp="receive")
    hardware.connect()
    hardware.write(np.zeros(len(ctx.joints)))
    with pytest.raises(HardwareError, match="nobody subscribes /arm/commands any more"):
        until_fault(hardware)


def test_a_node_that_dies_is_a_fault_and_comes_back_by_a_reset(make):
    _, ctx = make()
    hardware, _ = make(MATCHED, state(ctx), stamp="receive")
    hardware.connect()
    hardware._node._process.kill()
    with pytest.raises(HardwareError, match=r"died: killed by SIGKILL"):
        until_fault(hardware)
    hardware.reset_faults()
    assert np.isfinite(hardware.read().position).all()


def test_commands_can_be_trajectories(make):
    _, ctx = make()
    hardware, ctx = make(MATCHED, state(ctx), stamp="receive", command="trajectory")
    hardware.connect()
    command = hardware._command(np.full(len(ctx.joints), 0.3))
    assert isinstance(command, JointTrajectory)
    assert command.joint_names == ctx.joints
    assert command.header.stamp_ns == 0
    np.testing.assert_array_equal(command.points[0].positions, 0.3)
