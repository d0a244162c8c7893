"""Tests against LeRobot itself are collected only where it is installed."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import pytest

collect_ignore_glob = [] if find_spec("lerobot") else ["test_*.py"]

_PATIENCE_MS = 3000


@pytest.fixture
def patient_buses(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's bus, the SDK below it and ours wait longer for a reply.

    A busy machine may keep the emulator, a thread of this process, from answering for a while.
    """

    def wait(port: Any, packet_length: int) -> None:
        port.packet_start_time = port.getCurrentTime()
        port.packet_timeout = _PATIENCE_MS

    monkeypatch.setattr("lerobot.motors.feetech.feetech.patch_setPacketTimeout", wait)
    monkeypatch.setattr("scservo_sdk.port_handler.LATENCY_TIMER", _PATIENCE_MS / 2)
    monkeypatch.setattr("ibrobot_feetech.bus._ADAPTER_S", _PATIENCE_MS / 1000)
