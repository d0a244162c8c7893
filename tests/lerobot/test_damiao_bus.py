"""LeRobot's driver of Damiao motors on the emulator of `ibrobot-plugin-damiao`, beside ours."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import pytest
from ibrobot_damiao.bus import Channel, DamiaoBus
from ibrobot_damiao.emulator import EmulatedMotor, EmulatedMotors
from ibrobot_damiao.emulator.serve import SlcanServer
from lerobot.motors import Motor, MotorNormMode
from lerobot.motors.damiao import DamiaoMotorsBus

pytestmark = pytest.mark.lerobot
GOALS = {1: 10.0, 2: -20.0, 3: 5.0}
"""Motor -> goal [degrees]."""


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlcanServer]:
    """A busy machine may keep the emulator, a thread of this process, from answering for a while."""
    for name in ("MEDIUM_TIMEOUT_SEC", "SHORT_TIMEOUT_SEC"):
        monkeypatch.setattr(f"lerobot.motors.damiao.damiao.{name}", 0.2)
    with SlcanServer(EmulatedMotors(EmulatedMotor(motor) for motor in GOALS)) as server:
        yield server


def test_lerobots_driver_and_ours_move_the_same_motors_to_the_same_angles(adapter: SlcanServer) -> None:
    motors = {
        f"joint{motor}": Motor(motor, "dm4310", MotorNormMode.DEGREES, motor_type_str="dm4310", recv_id=motor + 0x10)
        for motor in GOALS
    }
    theirs = DamiaoMotorsBus(adapter.channel, motors, can_interface="slcan", use_can_fd=False)
    theirs.connect()
    for gain, value in (("Kp", 40.0), ("Kd", 4.0)):  # enough damping for no overshoot
        theirs.sync_write(gain, {f"joint{motor}": value for motor in GOALS})
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s:
        theirs.sync_write("Goal_Position", {f"joint{motor}": goal for motor, goal in GOALS.items()})
        if all(abs(math.degrees(adapter.motors[motor].angle) - goal) < 0.1 for motor, goal in GOALS.items()):
            break
    for _ in range(5):  # it takes answers that are still queued for the newest
        read = theirs.sync_read("Present_Position")
    theirs.disconnect()
    assert not any(motor.state for motor in adapter.motors.motors)

    ours = DamiaoBus(Channel(adapter.channel))
    ours.open()
    try:
        for motor, goal in GOALS.items():
            ours.find(motor)
            position = math.degrees(ours.ask(motor).position)
            assert position == pytest.approx(goal, abs=0.2)
            assert read[f"joint{motor}"] == pytest.approx(position, abs=0.2)
    finally:
        ours.close()
