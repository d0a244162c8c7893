"""LeRobot's own devices, unmodified, in device processes of ours, on the emulated bus."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from importlib import invalidate_caches
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_feetech.follower import FeetechFollower
from ibrobot_feetech.options import FollowerOptions
from ibrobot_lerobot_devices import hardware, link
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.options import RobotOptions
from ibrobot_testing.contexts import control_context, make_robot
from lerobot_version import LEROBOT
from packaging.version import Version

from ibrobot_core.api import HardwareError, Joint, RealClock, Robot, SteppedClock, Torque

pytestmark = [pytest.mark.lerobot, pytest.mark.usefixtures("patient_buses")]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
TICK = 2 * np.pi / 4096
CALIBRATION = {
    name: JointCalibration(servo, 0, -300 + 100 * servo, 500 + servo, 3500 + servo)
    for servo, name in enumerate(JOINTS, 1)
}
PATIENCE_S = 30.0
TORCH = Version("0.5") > LEROBOT
"""Whether LeRobot's devices call torch, and do not only import it."""
PATIENT = """
import select
import lerobot.motors.feetech.feetech as bus
from dataclasses import dataclass
from lerobot.robots import RobotConfig
from lerobot.robots.so_follower import SOFollower, SOFollowerRobotConfig
from scservo_sdk.port_handler import PortHandler

def wait(port, packet_length):
    port.packet_start_time = port.getCurrentTime()
    port.packet_timeout = 3000

def read(port, length):
    select.select([port.ser], [], [], 0.01)
    return bytes(port.ser.read(length))

bus.patch_setPacketTimeout = wait
PortHandler.readPort = read

@RobotConfig.register_subclass("patient_so101")
@dataclass
class PatientConfig(SOFollowerRobotConfig):
    pass

class Patient(SOFollower):
    config_class = PatientConfig

from lerobot.robots.lekiwi import LeKiwi, LeKiwiConfig

@RobotConfig.register_subclass("patient_lekiwi")
@dataclass
class PatientKiwiConfig(LeKiwiConfig):
    pass

class PatientKiwi(LeKiwi):
    config_class = PatientKiwiConfig
"""
"""A package for LeRobot: its robots, which wait longer for servos that a busy machine keeps from answering."""


@pytest.fixture(autouse=True)
def patient_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    site = tmp_path / "site"
    metadata = site / "lerobot_robot_patient-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot-robot-patient\nVersion: 1.0\n")
    (site / "lerobot_robot_patient.py").write_text(PATIENT)
    monkeypatch.syspath_prepend(str(site))
    invalidate_caches()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(hardware, "_WAIT", PATIENCE_S * 100)
    if "clock" in request.fixturenames:  # the real age of an answer would be one of another clock
        monkeypatch.setattr(hardware, "age_ns", lambda answer: 0)
    monkeypatch.setattr(link, "_FAREWELL_S", PATIENCE_S)
    monkeypatch.setattr(hardware, "_RELAX_S", PATIENCE_S)
    monkeypatch.setattr(hardware, "_RECONNECT_S", PATIENCE_S)


@pytest.fixture
def clock() -> SteppedClock:
    return SteppedClock()


@pytest.fixture
def emulator(clock: SteppedClock) -> Iterator[Emulator]:
    """An arm at the middle of its ranges, with its calibration."""
    with Emulator(clock=clock) as served:
        calibrate(served, CALIBRATION)
        yield served


def calibrate(emulator: Emulator, calibration: Mapping[str, JointCalibration]) -> None:
    """Write a calibration into the servos, and turn them to the middle of their ranges."""
    with emulator.lock:
        for joint in calibration.values():
            servo = emulator.servos[joint.id]
            servo.set("homing_offset", joint.homing_offset)
            servo.set("min_position_limit", joint.range_min)
            servo.set("max_position_limit", joint.range_max)
            servo.turn(joint.range_middle + joint.homing_offset)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """LeRobot's calibration folder, with the file of the arm."""
    save_calibration(Calibration(dict(CALIBRATION)), tmp_path / "arm.json")
    return tmp_path


def goals(emulator: Emulator) -> list[int]:
    with emulator.lock:
        return [emulator.servos[servo].get("goal_position") for servo in range(1, 7)]


def test_so101_follower_moves_as_our_own_driver(emulator: Emulator, clock: SteppedClock, folder: Path) -> None:
    """Positions and goals are those of our driver, within the tick that LeRobot cuts off."""
    config = {"port": emulator.port, "id": "arm", "calibration_dir": str(folder)}
    theirs = LeRobotHardware(
        RobotOptions("patient_so101", config, torch=TORCH), control_context("theirs", clock=RealClock())
    )
    theirs.connect()
    ours = FeetechFollower(
        FollowerOptions(emulator.port, str(folder / "arm.json")), control_context("ours", clock=clock)
    )
    try:
        begun = theirs.read().position
        wanted = begun + np.array([0.3, -0.2, 0.25, 0.1, -0.4, 0.3])
        theirs.write(wanted)
        theirs.read()
        sent = goals(emulator)
        clock.advance(5_000_000_000)
        reached = theirs.read().position
        assert theirs.relax() is Torque.OFF
    finally:
        theirs.disconnect()
    ours.connect()
    try:
        np.testing.assert_allclose(ours.read().position, reached, atol=TICK)
        ours.write(wanted)
        ours.read()
        np.testing.assert_allclose(goals(emulator), sent, atol=1)
    finally:
        ours.relax()
        ours.disconnect()
    np.testing.assert_allclose(reached, wanted, atol=2 * TICK)


def test_an_arm_without_its_cable_is_named_and_comes_back(emulator: Emulator, folder: Path) -> None:
    config: dict[str, Any] = {"port": emulator.port, "id": "arm", "calibration_dir": str(folder)}
    if Version("0.6") <= LEROBOT:
        config["num_read_retries"] = 0
    options = RobotOptions("patient_so101", config, lost_readings=0, torch=TORCH)
    arm = LeRobotHardware(options, control_context("arm", clock=RealClock()))
    arm.connect()
    try:
        assert not arm.read().stale
        emulator.faults.silent.add(3)
        with pytest.raises(HardwareError, match="arm: ConnectionError: Failed to sync read 'Present_Position'"):
            arm.read()
        emulator.faults.silent.clear()
        arm.reset_faults()
        assert not arm.read().stale
        held = arm.holding()
        assert held is not None
        assert json.dumps(config) in held.command
    finally:
        arm.disconnect()
    with emulator.lock:
        assert [emulator.servos[servo].get("torque_enable") for servo in range(1, 7)] == [1] * 6


def test_lekiwi_drives_and_measures_its_way(clock: SteppedClock, tmp_path: Path) -> None:
    """A turn and a way ahead by LeRobot's kinematics of three wheels, as joints; then it stands."""
    wheels = ("base_left_wheel", "base_back_wheel", "base_right_wheel")
    calibration = {f"arm_{name}": joint for name, joint in CALIBRATION.items()}
    calibration |= {name: JointCalibration(servo, 0, 0, 0, 4095) for servo, name in enumerate(wheels, 7)}
    save_calibration(Calibration(calibration), tmp_path / "kiwi.json")
    axes = tuple(Joint(name, -1000.0, 1000.0, 0.5, 5.0) for name in ("x", "y", "theta"))
    arm = make_robot().joints
    robot = Robot("kiwi", (*arm, *axes))
    with Emulator(9, clock=clock) as emulator:
        calibrate(emulator, calibration)
        config = {"port": emulator.port, "id": "kiwi", "calibration_dir": str(tmp_path), "cameras": {}}
        names = {f"arm_{name}": name for name in JOINTS}
        kiwi = LeRobotHardware(
            RobotOptions("patient_lekiwi", config, names, torch=TORCH),
            control_context("kiwi", robot=robot, joints=robot.joint_names, clock=clock),
        )
        kiwi.connect()
        try:
            begun = kiwi.read().position
            velocity = np.array([*[0.0] * 6, 0.15, 0.0, -0.3])
            for tick in range(1, 51):
                kiwi.write(begun + tick * 0.01 * velocity)
                clock.advance(10_000_000)
                reading = kiwi.read()
            np.testing.assert_allclose(reading.position[6:], 0.5 * velocity[6:], atol=0.02)
            np.testing.assert_allclose(reading.velocity[6:], velocity[6:], atol=0.03)
            kiwi.relax()
        finally:
            kiwi.disconnect()
        assert [emulator.servos[servo].get("goal_velocity") for servo in (7, 8, 9)] == [0, 0, 0]
