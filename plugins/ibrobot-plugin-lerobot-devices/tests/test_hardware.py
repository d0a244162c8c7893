"""Hardware `lerobot` with a fake LeRobot in a real device process: the suite of hardware, and faults."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, override

import numpy as np
import pytest
from ibrobot_lerobot_devices import link
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem
from ibrobot_lerobot_devices.options import RobotOptions
from ibrobot_testing.contexts import control_context
from ibrobot_testing.hardware import HardwareSuite

from ibrobot_core.api import Context, Hardware, HardwareError, JointReading, RealClock, Torque

from .conftest import JOINTS, PATIENCE_S, Motors, install

TURN = 2 * math.pi


def options(motors: Motors, **changes: Any) -> RobotOptions:
    config = {"port": str(motors.port), "id": "tester", **changes.pop("config", {})}
    return RobotOptions(robot=changes.pop("robot", "fake_arm"), config=config, **changes)


class TestLeRobot(HardwareSuite):
    settle_s = 0.03

    @pytest.fixture(autouse=True)
    def _arm(self, motors: Motors, patient: None) -> None:
        self.motors = motors

    @override
    def context(self) -> Context:
        return control_context(clock=RealClock())

    @override
    def make(self, ctx: Context) -> Hardware:
        return LeRobotHardware(options(self.motors), ctx)


@contextmanager
def connected(motors: Motors, **changes: Any) -> Iterator[LeRobotHardware]:
    hardware = LeRobotHardware(options(motors, **changes), control_context("arm", clock=RealClock()))
    hardware.connect()
    try:
        yield hardware
    finally:
        hardware.disconnect()


@pytest.mark.usefixtures("patient")
class TestUnits:
    def test_positions_are_radians_by_the_calibration(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            position = hardware.read().position
        tick = TURN / 4096
        degrees = 2000 + 5 * 4095 / 360 - 2048  # from the middle of the range, 2000, to that of the encoder
        share = 2000 + 5 / 100 * 1300 - 2048
        turned = -(2000 - 5 / 100 * 1300 - 2048)
        closed = 40 / 100 * 2600 * tick - 0.2
        expected = [degrees * tick, share * tick, turned * tick, degrees * tick, degrees * tick, closed]
        np.testing.assert_allclose(position, expected, atol=1e-9)

    def test_zero_is_in_the_middle_of_the_range_if_asked_for(self, motors: Motors) -> None:
        with connected(motors, zero_at="range", inverted=("wrist_flex",)) as hardware:
            position = hardware.read().position
        assert position[0] == pytest.approx(5 * 4095 / 360 * TURN / 4096)
        assert position[3] == -position[0]

    def test_a_joint_of_another_name_is_given(self, motors: Motors) -> None:
        with pytest.raises(HardwareError, match="LeRobot has no joint 'shoulder_pan'; it has shoulder_pan, should"):
            LeRobotHardware(
                options(motors, names={"shoulder_pan": "other"}), control_context(clock=RealClock())
            ).connect()


@pytest.mark.usefixtures("patient")
class TestFaults:
    def test_a_device_that_is_not_calibrated_is_named(self, motors: Motors) -> None:
        with (
            pytest.raises(HardwareError, match=r"arm: is not calibrated: .* its file is arm.json"),
            connected(motors, config={"id": None}),
        ):
            pass

    def test_a_missing_port_is_named(self, motors: Motors) -> None:
        motors.port.rename(motors.port.with_suffix(".away"))
        with pytest.raises(HardwareError, match="arm: ConnectionError: no port"), connected(motors):
            pass

    def test_an_unknown_robot_is_named(self, motors: Motors) -> None:
        with (
            pytest.raises(HardwareError, match="LeRobot has no robot 'fake_arms', did you mean 'fake_arm'"),
            connected(motors, robot="fake_arms"),
        ):
            pass

    def test_single_failed_readings_are_stale_and_many_a_fault(self, motors: Motors) -> None:
        with connected(motors, lost_readings=2) as hardware:
            hardware.read()
            motors.suffer("fail")
            assert [hardware.read().stale for _ in range(2)] == [True, True]
            with pytest.raises(HardwareError, match="arm: ConnectionError: the motors do not answer"):
                hardware.read()
            motors.suffer("")
            with pytest.raises(HardwareError):
                hardware.read()
            hardware.reset_faults()
            assert not hardware.read().stale

    def test_positions_that_are_not_finite_are_a_fault(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            motors.suffer("nan")
            with pytest.raises(HardwareError, match="no finite position of shoulder_pan"):
                [hardware.read() for _ in range(4)]

    def test_a_process_that_dies_is_a_fault_and_a_reset_starts_another(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            pid = hardware._link.pid
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
            with pytest.raises(HardwareError, match="LeRobot's process has ended: killed by SIGKILL"):
                hardware.read()
            with pytest.raises(HardwareError):
                hardware.write(np.zeros(6))
            hardware.reset_faults()
            assert not hardware.read().stale
            assert hardware._link.pid != pid


def fresh(hardware: LeRobotHardware) -> JointReading:
    """The first reading that is not stale."""
    while (reading := hardware.read()).stale:
        pass
    return reading


def reset(hardware: LeRobotHardware) -> None:
    """As an operator does, who resets again while LeRobot starts."""
    for _ in range(20):
        with suppress(HardwareError):
            hardware.reset_faults()
            return
    hardware.reset_faults()


class TestBlocked:
    @pytest.mark.parametrize(
        ("fault", "text"),
        [
            ("block", r"does not return for 0\.\d+ s$"),
            ("silent", r"0\.\d+ s: nothing comes from its port; check the motors' power and cable$"),
            ("garbage", r"0\.\d+ s: \d+ bytes have come from its port, but no valid answer of all motors; check"),
        ],
    )
    def test_a_silent_port_and_garbage_have_different_messages(
        self, motors: Motors, fault: str, text: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(link, "_TRAFFIC_S", PATIENCE_S)
        with connected(motors, blocked=0.2) as hardware:
            fresh(hardware)
            motors.suffer(fault)
            with pytest.raises(HardwareError, match=text):
                [hardware.read() for _ in range(100_000)]
            motors.suffer("")

    def test_a_blocked_call_is_named_and_the_arm_keeps_its_last_goal(self, motors: Motors) -> None:
        with connected(motors, blocked=0.05) as hardware:
            reading = fresh(hardware)
            hardware.write(reading.position)
            motors.suffer("block")
            readings: list[JointReading] = []
            with pytest.raises(HardwareError, match=r"fake_arm.get_observation does not return for 0\.\d+ s"):
                readings.extend(hardware.read() for _ in range(10_000))
            assert readings[-1].stale
            hardware.write(reading.position + 0.1)  # does not block either
            assert motors.content["torque"]
            motors.suffer("")
            reset(hardware)
            np.testing.assert_allclose(fresh(hardware).position, reading.position + 0.1, atol=1e-9)

    def test_a_process_that_is_blocked_at_the_end_is_ended(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            motors.suffer("block")
            hardware.read()
            pid = hardware._link.pid
        assert pid is not None
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)

    def test_a_blocked_relax_is_not_confirmed(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            motors.suffer("block")
            assert hardware.relax() is Torque.UNKNOWN
            assert hardware.holding() is not None


@pytest.mark.usefixtures("patient")
class TestTorque:
    def test_the_torque_stays_as_it_is_at_the_end(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            hardware.read()
        assert motors.content["torque"]
        assert hardware.holding() is not None

    def test_relax_switches_it_off_and_a_command_on_again_where_the_arm_is(self, motors: Motors) -> None:
        with connected(motors) as hardware:
            assert hardware.relax() is Torque.OFF
            assert not motors.content["torque"]
            reading = hardware.read()
            hardware.write(reading.position)
            np.testing.assert_allclose(hardware.read().position, reading.position, atol=1e-9)
            assert motors.content["torque"]


@pytest.mark.usefixtures("patient")
def test_a_third_party_robot_is_found_as_lerobot_finds_it(motors: Motors, lerobot: Path) -> None:
    (lerobot / "lerobot_robot_mine.py").write_text(
        "from dataclasses import dataclass\n"
        "from lerobot.robots import RobotConfig\n"
        "from lerobot.robots.arm import Arm, ArmConfig\n"
        "@RobotConfig.register_subclass('mine')\n@dataclass\n"
        "class MineConfig(ArmConfig):\n    device = Arm\n"
    )
    install(lerobot, "lerobot_robot_mine")
    with connected(motors, robot="mine") as hardware:
        assert hardware.joints == JOINTS
        assert not hardware.read().stale


@pytest.mark.parametrize(
    "error", ["ImportError('no libmotor.so')", "RuntimeError('no libmotor.so')", "SystemExit('no libmotor.so')"]
)
def test_a_package_that_cannot_be_imported_is_named_once(
    lerobot: Path, caplog: pytest.LogCaptureFixture, error: str
) -> None:
    (lerobot / "lerobot_robot_broken.py").write_text(f"raise {error}\n")
    install(lerobot, "lerobot_robot_broken")
    link = DeviceLink("robot", "nowhere", {}, only_make=True)
    with caplog.at_level("WARNING", "ibrobot"), pytest.raises(DeviceProblem, match="LeRobot has no robot 'nowhere'"):
        link.start(PATIENCE_S)
    assert caplog.messages == ["package lerobot_robot_broken cannot be imported: no libmotor.so"]
