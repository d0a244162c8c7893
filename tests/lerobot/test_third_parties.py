"""Packages of others from the index, unmodified, which add robots to LeRobot: they drive runs of ours."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from ibrobot_feetech.emulator import EmulatedServo, Emulator
from ibrobot_testing import ibrobot_command

FOLDER = Path(os.environ.get("IBROBOT_THIRD_PARTIES", "/nowhere"))
"""Where they are installed: beside the environment, since each makes LeRobot import it."""
pytestmark = [
    pytest.mark.lerobot,
    pytest.mark.long,  # each command starts LeRobot with torch, some of them twice
    pytest.mark.skipif(not FOLDER.is_dir(), reason="needs IBROBOT_THIRD_PARTIES, as `nox -s lerobot` sets it"),
]


def ibrobot(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(FOLDER), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(folder / "cache")}
    command = [*ibrobot_command(), *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_robot_without_motors_holds_its_pose(tmp_path: Path) -> None:
    """lerobot-robot-dummy: all joints are always at 0."""
    done = ibrobot(tmp_path, "config", "new", "dummy.yaml", "--lerobot", "dummy_follower", "--unit", "degrees")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("dummy.yaml: dummy_follower, 7 joints\n")
    done = ibrobot(
        tmp_path,
        "launch",
        "dummy.yaml",
        "--headless",
        "--duration",
        "1",
        "--set",
        "control.state_timeout=20",
        "--set",
        "hardware.blocked=10",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "faults     none" in done.stdout
    assert "[DEBUG DUMMY] Received Action" in done.stdout + done.stderr  # the package prints what it is sent


def test_a_robot_with_a_base_has_its_axes_and_names_what_is_missing(tmp_path: Path) -> None:
    """lerobot-robot-lekiwi-pincopen: its bus has other servos than those of the emulator."""
    done = ibrobot(tmp_path, "config", "new", "kiwi.yaml", "--lerobot", "lekiwi_pincopen")
    assert done.returncode == 0, done.stdout + done.stderr
    text = (tmp_path / "kiwi.yaml").read_text()
    assert "base: [x, y, theta]" in text
    assert "teleop: {base: cmd_vel}" in text
    port = "hardware.config.port"
    done = ibrobot(tmp_path, "launch", "kiwi.yaml", "--headless", "--duration", "1", "--set", f"{port}=/dev/missing")
    assert done.returncode == 1
    assert "error: control: hardware: ConnectionError: Could not connect on port '/dev/missing'." in done.stderr
    with Emulator({servo: EmulatedServo(servo) for servo in range(1, 10)}) as emulator:
        done = ibrobot(
            tmp_path, "launch", "kiwi.yaml", "--headless", "--duration", "1", "--set", f"{port}={emulator.port}"
        )
    assert done.returncode == 1
    assert "Full found motor list (id: model_number): {1: 777, " in done.stderr
