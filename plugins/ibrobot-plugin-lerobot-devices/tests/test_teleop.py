"""Teleop `lerobot` with a fake LeRobot in a real device process: the suite of teleoperation, and its errors."""

from __future__ import annotations

import queue
from typing import Any, override

import numpy as np
import pytest
from ibrobot_lerobot_devices import teleop
from ibrobot_lerobot_devices.options import TeleopOptions
from ibrobot_lerobot_devices.teleop import LeRobotTeleop
from ibrobot_testing.contexts import host_context
from ibrobot_testing.teleop import TeleopSuite

from ibrobot_core.api import Context, JointReading, Teleop, TeleopError, nan_vector

from .conftest import JOINTS, PATIENCE_S, Motors


def options(motors: Motors, **changes: Any) -> TeleopOptions:
    return TeleopOptions(teleop="fake_leader", config={"port": str(motors.port), "id": "tester"}, **changes)


class TestLeRobotTeleop(TeleopSuite):
    @pytest.fixture(autouse=True)
    def _leader(self, motors: Motors, ageless: None) -> None:
        self.motors = motors
        self.keys: queue.SimpleQueue[str] = queue.SimpleQueue()

    @override
    def context(self) -> Context:
        return host_context(keys=lambda: self.keys)

    @override
    def make(self, ctx: Context) -> Teleop:
        return LeRobotTeleop(options(self.motors, deadman="hold"), ctx)

    @override
    def engage(self, teleop: Teleop) -> None:
        self._thaw()
        self.keys.put("space")
        self.keys.put("repeat:space")

    @override
    def operate(self, teleop: Teleop) -> None:
        self._thaw()
        self.keys.put("repeat:space")
        self.motors.move(shoulder_pan=self.motors.content["positions"]["shoulder_pan"] + 1.0)

    @override
    def release(self, teleop: Teleop) -> None:
        self._thaw()
        self.keys.put("release:space")

    @override
    def freeze(self, device: Teleop) -> None:
        teleop._WAIT_S = 0.0
        self.motors.suffer("block")

    def _thaw(self) -> None:
        teleop._WAIT_S = PATIENCE_S
        self.motors.suffer("")


def measured(ctx: Context) -> JointReading:
    ctx.clock.sleep_until(ctx.clock.now_ns() + ctx.period_ns)
    return JointReading(ctx.clock.now_ns(), np.zeros(6), np.zeros(6), nan_vector(6))


@pytest.mark.usefixtures("ageless")
class TestErrors:
    def test_a_device_without_joint_positions_is_named(self) -> None:
        device = LeRobotTeleop(TeleopOptions("fake_stick", deadman="none"), host_context("stick"))
        with pytest.raises(TeleopError, match="stick: LeRobot's fake_stick commands delta_x, delta_y, and no joint"):
            device.connect()

    def test_a_deadman_needs_a_terminal(self, motors: Motors) -> None:
        with pytest.raises(TeleopError, match="leader: deadman: toggle needs a terminal"):
            LeRobotTeleop(options(motors), host_context("leader")).connect()

    def test_a_blocked_call_is_named(self, motors: Motors, monkeypatch: pytest.MonkeyPatch) -> None:
        ctx = host_context("leader")
        device = LeRobotTeleop(options(motors, deadman="none", blocked=0.05), ctx)
        device.connect()
        try:
            motors.suffer("block")
            monkeypatch.setattr(teleop, "_WAIT_S", 0.001)
            with pytest.raises(TeleopError, match=r"leader: LeRobot's fake_leader.get_action does not return"):
                [device.read(measured(ctx)) for _ in range(100_000)]
        finally:
            device.disconnect()

    def test_many_failed_readings_are_an_error(self, motors: Motors) -> None:
        ctx = host_context("leader")
        device = LeRobotTeleop(options(motors, deadman="none", lost_readings=1), ctx)
        device.connect()
        try:
            motors.suffer("fail")
            assert device.read(measured(ctx)).positions is None
            with pytest.raises(TeleopError, match="leader: ConnectionError: the motors do not answer"):
                device.read(measured(ctx))
        finally:
            device.disconnect()


@pytest.mark.usefixtures("ageless")
def test_without_a_terminal_the_robot_follows_once_the_device_is_moved(motors: Motors) -> None:
    ctx = host_context("leader")
    device = LeRobotTeleop(options(motors, deadman="none", ramp_velocity=1000.0), ctx)
    device.connect()
    try:
        device.activate(measured(ctx))
        assert [device.read(measured(ctx)).positions for _ in range(3)] == [None] * 3
        motors.move(gripper=100.0, shoulder_pan=15.0)
        found = [device.read(measured(ctx)).positions for _ in range(200)][-1]
        assert found is not None
        assert tuple(found) == JOINTS
        assert found["gripper"] == ctx.robot.upper[5]  # its share of the range maps to the robot's limits
    finally:
        device.disconnect()
