"""An arm calibrated in the dialogue, and its file in LeRobot's hands."""

from __future__ import annotations

import itertools
from pathlib import Path

import draccus
import pytest
from ibrobot_feetech.emulator import Emulator
from ibrobot_testing.terminal import Terminal
from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus

pytestmark = [pytest.mark.lerobot, pytest.mark.usefixtures("patient_buses")]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PATIENCE = "from ibrobot_feetech import bus\nbus._ADAPTER_S = 0.5"
STEPS = (*range(0, -1100, -50), *range(-1100, 1101, 50), *range(1100, -1, -50))


def test_lerobot_takes_a_calibration_made_in_the_dialogue(tmp_path: Path) -> None:
    path = tmp_path / "arm.json"
    with Emulator(6) as emulator:
        middles = {servo: 500 * servo for servo in emulator.servos}
        poses = itertools.cycle(STEPS)

        def move() -> None:
            step = next(poses)
            for number, servo in emulator.servos.items():
                servo.turn((middles[number] + step) % 4096)

        for number, servo in emulator.servos.items():
            servo.turn(middles[number])
        arguments = ("feetech", "calibrate", emulator.port, "--name", str(path), "--accept-ranges")
        with Terminal(*arguments, before=PATIENCE) as terminal:
            terminal.wait_for("Then press Enter")
            terminal.type("\r")
            terminal.wait_for("(Enter ends it)")
            emulator.on_request = move
            for _ in range(2):
                terminal.wait_for("2200")  # the span of every joint
            emulator.on_request = lambda: None
            terminal.type("\r")
            terminal.wait_for("written to servos")
            assert terminal.end() == 0
        with path.open() as file, draccus.config_type("json"):
            loaded = draccus.load(dict[str, MotorCalibration], file)
        assert list(loaded) == list(JOINTS)
        assert loaded["elbow_flex"] == MotorCalibration(3, 0, 1500 - 2048, 948, 3148)
        motors = {name: Motor(i, "sts3215", MotorNormMode.RANGE_M100_100) for i, name in enumerate(JOINTS, 1)}
        bus = FeetechMotorsBus(emulator.port, motors, loaded)
        bus.connect()
        try:
            # The same numbers are in the servos, and LeRobot sees no difference.
            assert bus.is_calibrated
            for number, servo in emulator.servos.items():
                servo.turn(middles[number])
            assert bus.sync_read("Present_Position", normalize=False) == dict.fromkeys(JOINTS, 2048)
        finally:
            bus.disconnect(disable_torque=False)
