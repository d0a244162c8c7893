"""LeRobot's Koch follower and leader on emulated Dynamixel buses: calibrate, teleoperate, record, convert, replay."""

from __future__ import annotations

import json
import math
import os
import select
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from dynamixel_bus import XL330_M077, XL330_M288, XL430, DynamixelBus, Servo
from ibrobot_testing import ibrobot_command
from lerobot.robots.koch_follower import KochFollower, KochFollowerConfig
from lerobot.teleoperators.koch_leader import KochLeader, KochLeaderConfig

pytestmark = pytest.mark.lerobot

FOLLOWER = (XL430, XL430, XL330_M288, XL330_M288, XL330_M288, XL330_M288)
LEADER = (XL330_M077,) * 6
ENDS = (900, 3100)
"""Positions between which the hand moves each joint at calibration [ticks]."""
PATIENT = (
    "control.state_timeout=60",
    "hardware.lost_readings=1000",
    "hardware.blocked=60",
    "teleoperation.leader.lost_readings=1000",
    "teleoperation.leader.blocked=60",
    "teleoperation.leader.deadman=none",
)
"""A busy machine may keep the emulators, threads of this process, from answering."""
PATIENT_SDK = """
import select
import dynamixel_sdk.port_handler as handler

def read_port(port, length):
    select.select([port.ser], [], [], 0.01)
    return port.ser.read(length)

handler.LATENCY_TIMER = 1500
handler.PortHandler.readPort = read_port
"""
"""The SDK below LeRobot's bus waits longer, and with a pause: its loop without one keeps emulators from answering."""


def read_port(port: Any, length: int) -> bytes:
    """As in `PATIENT_SDK`, for this process."""
    select.select([port.ser], [], [], 0.01)
    return bytes(port.ser.read(length))


def servos(models: tuple[int, ...]) -> list[Servo]:
    return [Servo(number, model, turned=1000.0 + 100 * number) for number, model in enumerate(models, 1)]


def calibrate(arm: Any, bus: DynamixelBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's calibration, with a hand that moves every joint from one end to the other, and then to the middle."""
    steps = iter([*((end, False) for end in ENDS), (sum(ENDS) / 2, True)])

    def moved() -> bool:
        position, enter = next(steps)
        with bus.lock:
            for servo in bus.servos.values():
                servo.turn_to(position)
        return enter

    monkeypatch.setattr("builtins.input", lambda prompt="": "")
    monkeypatch.setattr("lerobot.motors.motors_bus.enter_pressed", moved)
    arm.bus.connect()
    arm.calibrate()
    arm.bus.disconnect()


@contextmanager
def moved_by_hand(bus: DynamixelBus) -> Iterator[None]:
    """A hand that waves with the first joint of a leader."""
    ended = threading.Event()

    def wave() -> None:
        for step in range(100_000):
            if ended.wait(0.02):
                return
            with bus.lock:
                bus.servos[1].turn_to(2048 + 250 * math.sin(step * 0.04))

    thread = threading.Thread(target=wave)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.mark.long
def test_koch_from_calibration_to_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(PATIENT_SDK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 1500)
    monkeypatch.setattr("dynamixel_sdk.port_handler.PortHandler.readPort", read_port)
    calibrations = tmp_path / "calibration"
    monkeypatch.setenv("HF_LEROBOT_CALIBRATION", str(calibrations))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def ibrobot(*arguments: str) -> str:
        done = subprocess.run(
            [*ibrobot_command(), *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    with DynamixelBus(servos(FOLLOWER)) as arm, DynamixelBus(servos(LEADER)) as leader:
        follower = KochFollowerConfig(
            port=arm.port, id="koch_follower", calibration_dir=calibrations / "robots" / "koch_follower"
        )
        leading = KochLeaderConfig(
            port=leader.port, id="koch_leader", calibration_dir=calibrations / "teleoperators" / "koch_leader"
        )
        calibrate(KochFollower(follower), arm, monkeypatch)
        calibrate(KochLeader(leading), leader, monkeypatch)
        monkeypatch.setenv("IBROBOT_FOLLOWER_PORT", arm.port)
        monkeypatch.setenv("IBROBOT_LEADER_PORT", leader.port)
        assert "6 joints\n" in ibrobot("config", "new", "koch.yaml", "--lerobot", "koch_follower")
        sets = [word for each in PATIENT for word in ("--set", each)]
        with moved_by_hand(leader):
            ibrobot(
                "record", "koch.yaml", "--mode", "teleop", "--headless", "--continuous", "--duration", "6",
                "--prompt", "wave", *sets,
            )  # fmt: skip
        ibrobot("convert", "episodes/default", "--out", "dataset", "--norm-mode", "radians")
        info = json.loads((tmp_path / "dataset" / "meta" / "info.json").read_text())
        assert info["robot_type"] == "koch_follower"
        (file,) = (tmp_path / "dataset" / "data").rglob("*.parquet")
        table = pq.read_table(file)
        states, actions = (np.array(table[name].to_pylist()) for name in ("observation.state", "action"))
        tick = 2 * math.pi / 4096
        assert np.ptp(states[-60:, 0]) > 300 * tick  # it followed the leader, which waves by 500 ticks
        np.testing.assert_allclose(np.ptp(actions[-60:, 0]), 500 * tick, rtol=0.2)
        ibrobot("replay", "dataset:0", "koch.yaml", "--headless", *sets)
        with arm.lock:
            assert all(servo.get("torque_enable") for servo in arm.servos.values())  # control.stop: hold
