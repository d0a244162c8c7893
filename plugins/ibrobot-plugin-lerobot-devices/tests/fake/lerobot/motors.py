"""Motors that are where they were sent at once, and keep that in a file: what the tests see of them."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

from serial import Serial


class MotorNormMode(Enum):
    """Units."""

    RANGE_0_100 = "range_0_100"
    RANGE_M100_100 = "range_m100_100"
    DEGREES = "degrees"


@dataclass
class Motor:
    """A motor."""

    id: int
    model: str
    norm_mode: MotorNormMode


@dataclass
class MotorCalibration:
    """Its calibration."""

    drive_mode: int
    range_min: int
    range_max: int


class Bus:
    """The motors at a port, which is a file with their positions and their torque.

    A file beside it with the suffix `.fault` says what is wrong: `block`, `silent`, `garbage`, `fail` or `nan`.
    """

    apply_drive_mode = True
    model_resolution_table: ClassVar = {"sts3215": 4096}

    def __init__(self, port: str, motors: dict[str, Motor], calibration: dict[str, MotorCalibration]) -> None:
        self.port, self.motors, self.calibration = Path(port), motors, calibration
        self.is_connected = False

    def connect(self) -> None:
        if not self.port.exists():
            raise ConnectionError(f"no port {self.port}")
        self.is_connected = True
        self.enable_torque()

    def read(self) -> dict[str, float]:
        self._suffer()
        return json.loads(self.port.read_text())["positions"]

    def write(self, goals: dict[str, float]) -> None:
        self._suffer()
        content = json.loads(self.port.read_text())
        if content["torque"]:
            self._put(content | {"positions": content["positions"] | goals})

    def enable_torque(self) -> None:
        self._put(json.loads(self.port.read_text()) | {"torque": True})

    def disable_torque(self) -> None:
        self._suffer()
        self._put(json.loads(self.port.read_text()) | {"torque": False})

    def _put(self, content: dict[str, object]) -> None:
        partial = self.port.with_suffix(".partial")
        partial.write_text(json.dumps(content))
        partial.rename(self.port)

    def _suffer(self) -> None:
        fault = self.port.with_suffix(".fault")
        port: Any = Serial()
        while (what := fault.read_text() if fault.exists() else "") in ("block", "silent", "garbage"):
            port.content = b"?" if what == "garbage" else b""
            if what != "block":
                port.read(8)
            time.sleep(0.002)
        if what == "fail":
            raise ConnectionError("the motors do not answer")
