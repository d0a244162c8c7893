"""Tests against LeRobot itself are collected only where it is installed."""

from __future__ import annotations

import importlib
import logging
import select
import signal
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

collect_ignore_glob = [] if find_spec("lerobot") else ["test_*.py"]

_GLANCE_S = 0.01
_PATIENCE_MS = 3000


@pytest.fixture
def lerobot_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Runs a command of LeRobot in this process, which has torch already."""

    def run(name: str, *arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", [f"lerobot-{name}", *arguments])
        importlib.import_module(f"lerobot.scripts.lerobot_{name}").main()

    monkeypatch.setattr("tqdm.tqdm.monitor_interval", 0)  # no thread of tqdm's
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path / "home"))
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield run
    root.handlers[:], root.level = before
    for number, handler in handlers.items():
        signal.signal(number, handler)


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
