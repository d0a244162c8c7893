"""The robot of the how-to on emulated motors: it runs, is recorded, and a motor that fails is named."""

from __future__ import annotations

import json
import os
import re
import subprocess
import threading
from pathlib import Path

import pytest
from ibrobot_damiao.emulator import EmulatedMotor, EmulatedMotors
from ibrobot_damiao.emulator.serve import SlcanServer
from ibrobot_testing import ibrobot_command
from ibrobot_testing.suite import wait_until

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "drive-a-can-arm.md"
JOINTS = 8


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """The YAML of the page, with a policy that moves each joint to another position."""
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    policy = "models: {wave: {type: fake}}\n"
    mode = "control_modes:\n  wave: {executors: [arm, gripper], inference: {model: wave}}\n"
    path = tmp_path / "openarm.yaml"
    path.write_text(policy + text.replace("control_modes:\n", mode))
    return path


def launched(robot: Path, adapter: SlcanServer, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A run of some seconds; a busy machine may keep the emulator, a thread of this process, from answering."""
    more = ("hardware.lost_replies=1000", "hardware.retries=20", "control.state_timeout=60")
    patient = [word for each in more for word in ("--set", each)]
    return subprocess.run(
        [*ibrobot_command(), "launch", str(robot), "--mode", "wave", "--headless", *patient, *arguments],
        env={**os.environ, "IBROBOT_CAN": adapter.channel},
        capture_output=True,
        text=True,
        timeout=120,
        cwd=robot.parent,
        check=False,
    )


def test_a_policy_moves_the_arm_and_the_end_says_how_to_take_the_torque_off(robot: Path) -> None:
    motors = EmulatedMotors(EmulatedMotor(motor) for motor in range(1, JOINTS + 1))
    with SlcanServer(motors) as adapter:
        ended = launched(robot, adapter, "--duration", "3", "--json")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["faults"] == []
    assert sum(abs(motor.angle) > 0.05 for motor in motors.motors) >= JOINTS // 2
    assert all(motor.state == 1 for motor in motors.motors)
    assert re.search(r"ibrobot damiao off socket://127.0.0.1:\d+ --id 1 .*--id 8", ended.stderr)


def test_a_hot_motor_stops_the_arm_and_is_named(robot: Path) -> None:
    motors = EmulatedMotors(EmulatedMotor(motor) for motor in range(1, JOINTS + 1))
    motors[4].coil = 100.0
    with SlcanServer(motors) as adapter:
        ended = launched(robot, adapter, "--duration", "2", "--json")
    faults = json.loads(ended.stdout)["faults"]
    assert "motor 4 (joint4): temperature 100 deg C, above max_temperature (90 deg C)" in str(faults)
    assert all(abs(motor.angle) < 0.1 for motor in motors.motors)


def test_a_cable_that_is_pulled_in_a_run_is_a_fault_that_says_what_to_check(robot: Path) -> None:
    motors = EmulatedMotors(EmulatedMotor(motor) for motor in range(1, JOINTS + 1))
    with SlcanServer(motors) as adapter:

        def pull() -> None:
            wait_until(lambda: any(abs(motor.angle) > 0.05 for motor in motors.motors), 60.0)
            adapter.unplug()

        pulling = threading.Thread(target=pull)
        pulling.start()
        ended = launched(robot, adapter, "--duration", "8", "--json")
        pulling.join()
    assert re.search(
        r"socket://127.0.0.1:\d+: (has failed|does not take a frame): .*; check the adapter's cable, and that no other",
        f"{ended.stdout} {ended.stderr}",
    ), ended.stderr
    assert ended.returncode != 0


@pytest.mark.parametrize(
    ("ids", "reason"),
    [
        ([1, 2, 3, 4, 5, 6, 7, 9], r"motor 8 \(gripper\): does not answer; check its power, its cable, and .* its id"),
        ([1, 2, 3, 4, 5, 6, 7, 7], r"motor 7 \(joint7\): 2 motors have this id; connect one at a time"),
        ([1, 2, 3, 4, 5, 16, 17, 8], r"no answer from motors 6 \(joint6\), 7 \(joint7\); check their power"),
    ],
)
def test_wrong_ids_are_named_before_a_motor_has_torque(robot: Path, ids: list[int], reason: str) -> None:
    motors = EmulatedMotors(EmulatedMotor(motor) for motor in ids)
    with SlcanServer(motors) as adapter:
        ended = launched(robot, adapter, "--duration", "2")
    assert re.search(reason, ended.stderr), ended.stderr
    assert ended.returncode != 0
    assert not any(motor.state for motor in motors.motors)
