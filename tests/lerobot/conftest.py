"""Tests against LeRobot itself are collected only where it is installed."""

from __future__ import annotations

import select
from importlib.util import find_spec
from typing import Any

import pytest

collect_ignore_glob = [] if find_spec("lerobot") else ["test_*.py"]

_GLANCE_S = 0.01
_PATIENCE_MS = 3000


@pytest.fixture
def patient_buses(monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's bus, the SDK below it and ours wait longer for a reply.

    A busy machine may keep the emulator, a thread of this process, from answering for a while. The SDK sleeps between
    its looks at the port: its loop without a pause would be what keeps the machine busy.
    """

    def wait(port: Any, packet_length: int) -> None:
        port.packet_start_time = port.getCurrentTime()
        port.packet_timeout = _PATIENCE_MS

    def read(port: Any, length: int) -> bytes:
        select.select([port.ser], [], [], _GLANCE_S)
        return bytes(port.ser.read(length))

    monkeypatch.setattr("lerobot.motors.feetech.feetech.patch_setPacketTimeout", wait)
    monkeypatch.setattr("scservo_sdk.port_handler.LATENCY_TIMER", _PATIENCE_MS / 2)
    monkeypatch.setattr("scservo_sdk.port_handler.PortHandler.readPort", read)
    monkeypatch.setattr("ibrobot_feetech.bus._ADAPTER_S", _PATIENCE_MS / 1000)
