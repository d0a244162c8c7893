"""Teleoperation over two emulated servo buses: a leader moved by hand, a follower in the control process."""

from __future__ import annotations

import math
import os
import queue
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_calibration.joint_units import calibrations
from ibrobot_data.cues import Cues
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.operator import Operator
from ibrobot_feetech import bus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from noting import Noting

from ibrobot_core.config import load_config
from ibrobot_core.control import host
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import ESTOP, RESET, Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import Float64MultiArray
from ibrobot_core.plugins import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("prompt_threads")]

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""
MAX_STEP = 3.0 * 0.01 * RADIAN
"""The velocity limit, for one tick of control [ticks]."""
PATIENCE_S = 60.0


def arm(folder: Path, name: str) -> tuple[Emulator, Path]:
    """An emulated arm at zero, and its calibration."""
    joints = {joint: JointCalibration(i + 1, 0, 0, 700, 3400) for i, joint in enumerate(JOINTS[:-1])}
    joints["gripper"] = JointCalibration(6, 0, 0, 1500, 2752)
    emulator = Emulator({number: Noting(number) for number in range(1, 7)}, link=folder / name)
    for joint in joints.values():
        servo = emulator.servos[joint.id]
        servo.set("min_position_limit", joint.range_min)
        servo.set("max_position_limit", joint.range_max)
    return emulator, save_calibration(Calibration(joints), folder / f"{name}.json")


@attrs.define
class Station:
    """Both arms and the run between them."""

    leader: Emulator
    follower: Emulator
    runtime: Runtime
    typed: queue.SimpleQueue[str]
    """Keys of the person at the terminal."""
    requests: int = 0
    """To the follower."""

    def count(self) -> None:
        self.requests += 1

    def fastest(self) -> float:
        """The longest step between two goals of a servo of the follower [ticks]."""
        servos = self.follower.servos.values()
        return max(float(np.abs(np.diff(servo.goals)).max()) for servo in servos if isinstance(servo, Noting))

    def turn(self, joint: str, angle: float) -> None:
        """A person moves a joint of the leader to an angle [rad], in steps of a hand however late they come."""
        servo = self.leader.servos[JOINTS.index(joint) + 1]
        for encoder in np.linspace(servo.encoder, 2048 + angle * RADIAN, 60):
            with self.leader.lock:
                servo.turn(float(encoder))
            self.runtime.wait(0.005)

    def angle(self, joint: str) -> float:
        """Where a joint of the follower is [rad]."""
        with self.follower.lock:
            return (self.follower.servos[JOINTS.index(joint) + 1].encoder - 2048) / RADIAN

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self.runtime.raise_failure()
            assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:.0f} s"
            self.runtime.wait(0.01)

    def reset(self) -> None:
        """Reset once the servos answer: a busy machine may keep the emulators from it."""
        self.until(self._resets, "a reset")

    def _resets(self) -> bool:
        try:
            self.runtime.session.bus.call(RESET, None)
        except IbrobotError:
            return False
        return True

    def press_space(self) -> None:
        """Follow the leader, or pause."""
        self.typed.put("space")

    def until_at(self, joint: str, angle: float) -> None:
        self.until(lambda: abs(self.angle(joint) - angle) < 0.01, f"{joint} comes to {angle} rad")

    @property
    def faults(self) -> list[str]:
        return self.runtime.session.outcome.faults

    def until_fault(self, count: int = 1) -> str:
        self.until(lambda: len(self.faults) >= count, "a fault")
        return self.faults[-1]

    def until_at_rest(self, requests_at_rest: int = 30) -> float:
        """Where the follower's pan comes to rest [rad]: an emulated joint moves when the control process asks."""
        last, since, requests = self.angle("shoulder_pan"), time.monotonic(), self.requests
        while time.monotonic() - since < 0.3 or self.requests < requests + requests_at_rest:
            self.runtime.wait(0.02)
            if abs(self.angle("shoulder_pan") - last) > 1e-4:
                last, since, requests = self.angle("shoulder_pan"), time.monotonic(), self.requests
        return last

    def assert_no_jump(self) -> None:
        """No goal was further from the one before it than the limits allow."""
        assert self.fastest() <= MAX_STEP + 1


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Station]]:
    monkeypatch.setattr(bus, "_ADAPTER_S", 0.5)
    monkeypatch.setattr(host, "_REPLY_TIMEOUT_S", PATIENCE_S)
    made: list[Any] = []

    def start(*overrides: str, **asked: Any) -> Station:
        leader, leader_file = arm(tmp_path, "leader")
        follower, follower_file = arm(tmp_path, "follower")
        sections = (
            f"hardware={{type: feetech_so101, port: {tmp_path}/follower, calibration: {follower_file}}}",
            f"teleoperation.leader={{type: so101_leader, port: {tmp_path}/leader, calibration: {leader_file}}}",
            "control_modes.teleop.teleop=leader",
            # A busy machine may keep the emulator, a thread of this process, from answering for a while.
            "hardware.lost_replies=1000",
            "hardware.retries=200",
            "teleoperation.leader.lost_replies=5",
            "control.state_timeout=20.0",
        )
        config = load_config(CONFIG, overrides=(*sections, *overrides), mode="teleop")
        typed = queue.SimpleQueue[str]()
        session = Session(config, installed_plugins(), LaunchRequest(keys=lambda: typed, **asked))
        station = Station(leader, follower, Runtime(session), typed)
        made.append(station)
        follower.on_request = station.count
        leader.start()
        follower.start()
        leader.servos[1].turn(2048 + 0.6 * RADIAN)
        station.runtime.start()
        return station

    yield start
    for station in made:
        station.runtime.stop()
        station.leader.stop()
        station.follower.stop()


def test_the_follower_comes_to_the_leader_without_a_jump_and_follows(station: Callable[..., Station]):
    arms = station("teleoperation.leader.ramp_velocity=0.15")
    assert arms.until_at_rest() == pytest.approx(0.0, abs=0.01), "a launch alone moves nothing"
    arms.press_space()
    arms.until_at("shoulder_pan", 0.6)
    # A setpoint is a tenth of a second from the one before it, where the host is slow, or the tolerance at the end.
    assert arms.fastest() <= 0.02 * RADIAN + 1 < MAX_STEP, "the approach is slower than the limits"
    for angle in (-0.5, 0.4):
        arms.turn("shoulder_pan", angle)
        arms.turn("elbow_flex", -angle)
        arms.until_at("shoulder_pan", angle)
        arms.until_at("elbow_flex", -angle)
    arms.assert_no_jump()
    assert arms.faults == []
    assert not any(servo.torque for servo in arms.leader.servos.values())


def test_an_unplugged_leader_is_a_fault_and_replugged_a_reset_goes_on(station: Callable[..., Station]):
    arms = station()
    arms.press_space()
    arms.until_at("shoulder_pan", 0.6)
    arms.leader.unplug()
    fault = arms.until_fault()
    assert "leader: " in fault
    assert "the port is" in fault
    stopped = arms.until_at_rest()
    assert stopped == pytest.approx(0.6, abs=0.05)
    with pytest.raises(IbrobotError, match="there is no such port"):
        arms.runtime.session.bus.call(RESET, None)

    arms.leader.servos[1].turn(2048 - 0.3 * RADIAN)
    arms.leader.replug()
    assert arms.until_at_rest() == pytest.approx(stopped, abs=2e-3), "nothing moves before the reset"
    arms.reset()
    # A servo that the fault caught on its way may come to rest a degree further on.
    assert arms.until_at_rest() == pytest.approx(stopped, abs=0.02), "a reset alone moves nothing"
    arms.press_space()
    arms.until_at("shoulder_pan", -0.3)
    arms.assert_no_jump()
    assert arms.faults == [fault]


def test_an_unplugged_follower_is_a_fault_and_replugged_a_reset_goes_on(station: Callable[..., Station]):
    arms = station()
    arms.press_space()
    arms.until_at("shoulder_pan", 0.6)
    arms.follower.unplug()
    fault = arms.until_fault()
    assert "follower: the port is" in fault
    with pytest.raises(IbrobotError, match="there is no such port"):
        arms.runtime.session.bus.call(RESET, None)

    arms.turn("shoulder_pan", -0.3)
    arms.follower.settle()  # the servos went on to their goals without the host
    arms.follower.replug()
    stopped = arms.until_at_rest(requests_at_rest=0)
    assert stopped == pytest.approx(0.6, abs=0.05)
    arms.reset()
    # A servo that the fault caught on its way may come to rest a degree further on.
    assert arms.until_at_rest() == pytest.approx(stopped, abs=0.02), "a reset alone moves nothing"
    arms.press_space()
    arms.until_at("shoulder_pan", -0.3)
    arms.assert_no_jump()
    assert not arms.runtime.session.finished.is_set()


def test_a_servo_of_the_leader_that_dies_is_named(station: Callable[..., Station]):
    arms = station("control.stop=relax")
    arms.press_space()
    arms.until_at("shoulder_pan", 0.6)
    arms.leader.faults.silent.add(3)
    assert "servo 3 (elbow_flex)" in arms.until_fault()
    arms.until(lambda: not any(servo.torque for servo in arms.follower.servos.values()), "torque goes off")


@pytest.mark.long  # the stepped tables of entrances and deadmen show this, with a simulated follower
def test_the_emergency_stop_holds_until_the_reset(station: Callable[..., Station]):
    arms = station()
    arms.press_space()
    arms.until_at("shoulder_pan", 0.6)
    arms.runtime.session.bus.call(ESTOP, None)
    arms.turn("shoulder_pan", -0.3)
    stopped = arms.until_at_rest()
    assert stopped == pytest.approx(0.6, abs=0.05)
    arms.reset()
    # A servo that the fault caught on its way may come to rest a degree further on.
    assert arms.until_at_rest() == pytest.approx(stopped, abs=0.02), "a reset alone moves nothing"
    arms.press_space()
    arms.until_at("shoulder_pan", -0.3)
    arms.assert_no_jump()


def test_a_recording_keeps_where_0_rad_is(tmp_path: Path):
    _, file = arm(tmp_path, "follower")
    hardware = f"hardware={{type: feetech_so101, port: {tmp_path}/follower, calibration: {file}}}"
    for zero_at in ("pose", "range"):
        (kept,) = calibrations(load_config(CONFIG, overrides=(hardware,), mode="teleop")).values()
        assert {joint["zero_at"] for joint in kept.values()} == {zero_at}
        file.with_suffix(".meta.json").unlink(missing_ok=True)  # as LeRobot's own


def test_one_person_records_episodes_of_two_tasks_by_keys(
    station: Callable[..., Station], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("ibrobot_data.operator.ENDING_S", 0.15)
    recording = f"recording={{type: mcap, root: {tmp_path}, dataset: alone}}"
    arms = station(recording, "contract.max_duration_s=0.4", "contract.rate_hz=50", by_operator=True)
    session, service = arms.runtime.session, arms.runtime.session.episodes
    assert isinstance(service, EpisodeService)
    heard, ear = os.pipe()
    operator = Operator(session, service, 4, 0.0, None, auto=False, keys=True, cues=Cues("beep", ear))
    wait = arms.runtime.wait
    monkeypatch.setattr(arms.runtime, "wait", lambda timeout_s: operator.step() or wait(timeout_s))

    def keys(*pressed: str) -> None:
        for key in pressed:
            arms.typed.put(key)
            operator.key(key)

    try:
        arms.until_at_rest()
        for number in range(1, 5):
            if number in (1, 3):  # of another task
                keys("tab" if number == 1 else "f11", *f"task {number}", "enter")
                arms.turn("shoulder_pan", 0.1 * number)  # the leader sinks while its hand types
                assert service.waiting
                arms.until(lambda: "PAUSED" in session.command_source.help(), "the arm waits")
                arms.press_space()
            else:
                keys("tab")
            arms.until(lambda number=number: service.number == number, "an episode begins")  # type: ignore[misc]
            arms.turn("elbow_flex", 0.2 if number % 2 else -0.2)
            arms.until(lambda number=number: service.saved == number, "an episode is saved")  # type: ignore[misc]
        arms.until(session.finished.is_set, "the run ends")
        assert os.read(heard, 999) == 4 * (1 + 2 + 3) * b"\a"
    finally:
        os.close(heard)
        os.close(ear)
    for folder in sorted((tmp_path / "alone/episodes").glob("episode_*")):
        reader = installed_plugins().open_episode(folder)
        (first, *_) = reader.messages(["/arm_position_controller/commands"])
        reader.close()
        assert isinstance(first.message, Float64MultiArray)
        way = abs(first.message.data[0] - 0.1 * (1 if folder.name < "episode_000003" else 3))
        assert way <= 0.06, f"{folder.name} begins while the arm is on its way to the leader"
