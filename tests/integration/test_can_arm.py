"""The CAN arm on emulated motors: calibrated, teleoperated, recorded and replayed, by the commands of an operator."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_damiao.emulator import EmulatedMotor, EmulatedMotors
from ibrobot_damiao.emulator.serve import SlcanServer
from ibrobot_testing import ibrobot_command

from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration
ROOT = Path(__file__).parents[2]
PATIENT = ("hardware.lost_replies=1000", "hardware.retries=20", "control.state_timeout=60", "control.peer_timeout=5")
"""A busy machine may keep the emulator, a thread of this process, from answering."""


@pytest.fixture
def motors() -> EmulatedMotors:
    return EmulatedMotors(EmulatedMotor(motor) for motor in range(1, 9))


@pytest.fixture
def adapter(motors: EmulatedMotors) -> Iterator[SlcanServer]:
    with SlcanServer(motors) as adapter:
        yield adapter


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """The robot of the how-to, with a device that waves with the first joint."""
    page = (ROOT / "docs/how-to/drive-a-can-arm.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    for line, more in (
        ("teleoperation:", "  waves: {type: waving}"),
        ("control_modes:", "  wave: {executors: [arm, gripper], teleop: waves}"),
        ("contract:", "  max_duration_s: 3"),
    ):
        assert text.count(f"{line}\n") == 1
        text = text.replace(f"{line}\n", f"{line}\n{more}\n")
    path = tmp_path / "openarm.yaml"
    path.write_text(text)
    return path


def ran(robot: Path, adapter: SlcanServer, *words: str) -> subprocess.CompletedProcess[str]:
    """A command, with the example's device on its path."""
    environment = {**os.environ, "IBROBOT_CAN": adapter.channel, "PYTHONPATH": str(robot.parent)}
    command = [*ibrobot_command(), *words]
    return subprocess.run(
        command, cwd=robot.parent, env=environment, capture_output=True, text=True, timeout=240, check=False
    )


def installed(folder: Path) -> None:
    """The device, as if it were installed."""
    (folder / "waving.py").write_bytes((ROOT / "tests/shared/plugins/waving.py").read_bytes())
    metadata = folder / "waving-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: waving\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[ibrobot]\nwaving = waving\n")


def test_calibrated_teleoperated_recorded_and_replayed(
    robot: Path, adapter: SlcanServer, motors: EmulatedMotors
) -> None:
    installed(robot.parent)
    options = [word for each in PATIENT for word in ("--set", each)]
    zero = ran(robot, adapter, "damiao", "zero", str(robot), "--yes")
    assert zero.returncode == 0, zero.stderr

    record = ran(
        robot,
        adapter,
        "record",
        str(robot),
        "--mode",
        "wave",
        "--headless",
        "--auto",
        "--duration",
        "2",
        "--episodes",
        "1",
        *options,
    )
    assert "faults" not in record.stderr, record.stderr
    assert record.returncode == 0, record.stderr
    (episode,) = (robot.parent / "episodes/default/episodes").iterdir()
    reader = installed_plugins().open_episode(episode)
    states = [np.asarray(each.message.position) for each in reader.messages({"/joint_states"})]  # type: ignore[attr-defined]
    reader.close()
    first = np.array(states)[:, 0]
    assert first.max() - first.min() > 0.3, "the first joint waved"

    replay = ran(robot, adapter, "replay", str(episode), str(robot), "--headless", "--json", *options)
    assert replay.returncode == 0, replay.stderr
    facts: Any = json.loads(replay.stdout)
    assert facts["faults"] == []
    assert abs(motors.motors[0].angle) > 0.0
