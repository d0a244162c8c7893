"""An emulated arm on a pseudo-terminal or a line in memory, with a calibration that fits the tests' robot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech import bus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_testing.contexts import ARM, GRIPPER

from .line import lay

ADAPTER_S = bus._ADAPTER_S
PATIENCE_S = 30.0
JOINTS = (*ARM, *GRIPPER)
OFFSETS = (-120, 35, 0, 900, -2000, 40)


def arm_calibration() -> Calibration:
    """A calibration with offsets of both signs, one joint inverted, and a gripper whose range begins off the middle."""
    joints = {
        name: JointCalibration(i + 1, int(name == "elbow_flex"), OFFSETS[i], 600, 3500)
        for i, name in enumerate(JOINTS[:-1])
    }
    return Calibration({**joints, "gripper": JointCalibration(6, 0, OFFSETS[5], 1500, 3000)}, robot="tester")


def prepare(emulator: Emulator, calibration: Calibration) -> None:
    """Write a calibration into the servos, and stand every joint in the middle of its range."""
    for joint in calibration.joints.values():
        servo = emulator.servos[joint.id]
        for name, value in (
            ("homing_offset", joint.homing_offset),
            ("min_position_limit", joint.range_min),
            ("max_position_limit", joint.range_max),
        ):
            servo.set(name, value)
        servo.turn((joint.range_min + joint.range_max) / 2 + joint.homing_offset)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may keep the emulator, a thread of this process, from answering for a while.

    So nothing may be silent or late here but on a `line`, which no machine delays.
    """
    monkeypatch.setattr(bus, "_ADAPTER_S", PATIENCE_S)


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Buses find the test's lines, and wait as long for replies as they always do."""
    lay(monkeypatch)
    monkeypatch.setattr(bus, "_ADAPTER_S", ADAPTER_S)


@pytest.fixture
def ports(lines: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Among tests with lines, one with a pseudo-terminal."""
    monkeypatch.setattr(bus, "_ADAPTER_S", PATIENCE_S)


@pytest.fixture
def calibration_file(tmp_path: Path) -> Path:
    return save_calibration(arm_calibration(), tmp_path / "arm.json")


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Emulator(6) as emulator:
        prepare(emulator, arm_calibration())
        yield emulator
