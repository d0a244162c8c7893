"""Two leaders drive two followers over four emulated servo buses, by the shipped robot YAML."""

from __future__ import annotations

import json
import math
import queue
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import attrs
import numpy as np
import pyarrow.parquet as pq
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_calibration.joint_units import calibrations
from ibrobot_data.episode import DATASET, Job, convert_episode
from ibrobot_data.request import ConversionRequest
from ibrobot_feetech import bus
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_lerobot.options import LeRobotOptions
from noting import Noting

from ibrobot_core.config import load_config
from ibrobot_core.contract.specs import Contract
from ibrobot_core.control import host
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import RESET, Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("prompt_threads")]

CONFIG = Path(__file__).parents[2] / "configs" / "bi_so101.yaml"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
SIDES = ("left", "right")
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""
MAX_STEP = 3.0 * 0.01 * RADIAN
"""The velocity limit, for one tick of control [ticks]."""
PATIENCE_S = 60.0
# No camera is connected; a busy machine may keep the emulators, threads of this process, from answering for a while.
OVERRIDES = (
    "peripherals=[]",
    "contract={}",
    "control.state_timeout=20.0",
    *(f"hardware.{side}_follower.{key}=1000" for side in SIDES for key in ("lost_replies", "retries")),
    *(f"teleoperation.leader_{side}.lost_replies=5" for side in SIDES),
    "teleoperation.leader_right.deadman_key=r",
)


def arm(folder: Path, name: str, prefix: str = "") -> Emulator:
    """An emulated arm at zero, with its calibration."""
    joints = {f"{prefix}{joint}": JointCalibration(i + 1, 0, 0, 700, 3400) for i, joint in enumerate(JOINTS[:-1])}
    joints[f"{prefix}gripper"] = JointCalibration(6, 0, 0, 1500, 2752)
    emulator = Emulator({number: Noting(number) for number in range(1, 7)}, link=folder / name)
    for joint in joints.values():
        servo = emulator.servos[joint.id]
        servo.set("min_position_limit", joint.range_min)
        servo.set("max_position_limit", joint.range_max)
    save_calibration(Calibration(joints), folder / f"{name}.json")
    return emulator


@attrs.define
class Station:
    """Four arms, and the run between them."""

    arms: dict[str, Emulator]
    keys: list[queue.SimpleQueue[str]] = attrs.field(factory=list)
    """The keys typed, for each device."""
    runtime: Runtime = attrs.field(init=False)

    def subscribe(self) -> queue.SimpleQueue[str]:
        self.keys.append(queue.SimpleQueue())
        return self.keys[-1]

    def press(self, key: str) -> None:
        for typed in self.keys:
            typed.put(key)

    def turn(self, side: str, angle: float) -> None:
        """A person moves a leader's pan to an angle [rad], in steps of a hand however late they come."""
        leader = self.arms[f"{side}_leader"]
        for encoder in np.linspace(leader.servos[1].encoder, 2048 + angle * RADIAN, 60):
            with leader.lock:
                leader.servos[1].turn(float(encoder))
            self.runtime.wait(0.005)

    def pan(self, side: str) -> float:
        """Where a follower's pan is [rad]."""
        follower = self.arms[f"{side}_follower"]
        with follower.lock:
            return (follower.servos[1].encoder - 2048) / RADIAN

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            self.runtime.raise_failure()
            assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:.0f} s"
            self.runtime.wait(0.01)

    def reset(self) -> bool:
        """Whether a reset succeeds; not while a busy machine keeps emulators from answering."""
        try:
            self.runtime.session.bus.call(RESET, None)
        except IbrobotError:
            return False
        return True

    def until_at(self, side: str, angle: float) -> None:
        self.until(lambda: abs(self.pan(side) - angle) < 0.01, f"the {side} pan comes to {angle} rad")

    def until_at_rest(self) -> None:
        last, since = [self.pan(side) for side in SIDES], time.monotonic()
        while time.monotonic() - since < 0.4:
            self.runtime.wait(0.02)
            now = [self.pan(side) for side in SIDES]
            if np.abs(np.subtract(now, last)).max() > 1e-3:
                last, since = now, time.monotonic()

    def fastest(self) -> float:
        """The longest step between two goals of a servo of the followers [ticks]."""
        servos = [servo for side in SIDES for servo in self.arms[f"{side}_follower"].servos.values()]
        return max(float(np.abs(np.diff(servo.goals)).max()) for servo in servos if isinstance(servo, Noting))


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Station]:
    monkeypatch.setattr(bus, "_ADAPTER_S", 0.5)
    monkeypatch.setattr(host, "_REPLY_TIMEOUT_S", PATIENCE_S)
    arms = {f"{side}_follower": arm(tmp_path, f"{side}_follower", f"{side}_") for side in SIDES}
    arms |= {f"{side}_leader": arm(tmp_path, f"{side}_leader") for side in SIDES}
    for name, emulator in arms.items():
        monkeypatch.setenv(f"IBROBOT_{name.upper()}_PORT", str(tmp_path / name))
        monkeypatch.setenv(f"IBROBOT_{name.upper()}_CALIBRATION", str(tmp_path / f"{name}.json"))
        emulator.start()
    station = Station(arms)
    config = load_config(CONFIG, overrides=OVERRIDES)
    station.runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(keys=station.subscribe)))
    try:
        station.runtime.start()
        yield station
    finally:
        station.runtime.stop()
        for emulator in arms.values():
            emulator.stop()


def test_each_leader_drives_its_follower_and_a_lost_one_stops_both(station: Station):
    station.turn("left", 0.5)
    station.turn("right", -0.4)
    station.press("space")
    station.until_at("left", 0.5)
    assert station.pan("right") == pytest.approx(0.0, abs=0.01), "the right leader has its own deadman"
    station.press("r")
    station.until_at("right", -0.4)
    station.turn("left", -0.2)
    station.until_at("left", -0.2)
    station.until_at("right", -0.4)

    station.arms["right_leader"].unplug()
    faults = station.runtime.session.outcome.faults
    station.until(lambda: bool(faults), "a fault")
    assert faults[0].startswith("leader_right: ")
    station.until_at_rest()
    held = station.pan("left")
    station.turn("left", 0.3)
    station.until_at_rest()
    assert station.pan("left") == pytest.approx(held, abs=0.01), "the left arm holds, too"

    station.arms["right_leader"].replug()
    station.until(station.reset, "a reset")
    station.until_at_rest()
    assert station.pan("left") == pytest.approx(held, abs=0.02), "a reset alone moves nothing"
    station.press("space")
    station.until_at("left", 0.3)
    assert station.fastest() <= MAX_STEP + 1


def test_datasets_have_the_names_of_lerobots_bimanual_robot(station: Station):
    contract = Contract.from_config(load_config(CONFIG))
    features = contract.features()
    names = tuple(f"{side}_{joint}.pos" for side in SIDES for joint in JOINTS)
    assert features["action"].names == names
    cameras = [key for key in features if key.startswith("observation.images.")]
    assert cameras == [f"observation.images.{name}" for name in ("top", "left_wrist", "right_wrist")]
    snapshot = calibrations(station.runtime.session.config)
    assert [joint for arm in snapshot.values() for joint in arm] == [name.removesuffix(".pos") for name in names]


def test_a_simulated_recording_becomes_a_dataset_of_two_arms(tmp_path: Path):
    overrides = [f"recording={{type: mcap, root: {tmp_path / 'episodes'}}}", "recording.topics=contract"]
    config = load_config(CONFIG, sim=True, overrides=overrides)
    typed = queue.SimpleQueue[str]()
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, keys=lambda: typed)))
    runtime.start()
    try:
        for i in range(40):
            for key in ("release:w", "w") if i == 1 else ("repeat:w",) * (i > 1):
                typed.put(key)
            runtime.step()
    finally:
        runtime.stop()
    runtime.raise_failure()
    (episode,) = (tmp_path / "episodes" / "default" / "episodes").iterdir()
    request = ConversionRequest(tmp_path / "all", LeRobotOptions(videos=False), "lerobot")
    report = convert_episode(Job(request, episode, "run", tmp_path / "unit"), lambda frames: None)
    assert report.frames == pytest.approx(12, abs=2)
    dataset = tmp_path / "unit" / DATASET
    info = json.loads((dataset / "meta" / "info.json").read_text())
    names = [f"{side}_{joint}.pos" for side in SIDES for joint in JOINTS]
    features = info["features"]
    assert info["robot_type"] == "bi_so_follower"
    for key in ("observation.state", "action"):
        assert (features[key]["shape"], features[key]["names"]) == ([12], names)
    for camera in ("top", "left_wrist", "right_wrist"):
        assert features[f"observation.images.{camera}"]["shape"] == [240, 320, 3]
    (rows,) = (dataset / "data").rglob("*.parquet")
    moved = np.ptp(np.array(pq.read_table(rows)["action"].to_pylist()), axis=0)
    assert moved[0] > 0.1, "the left pan"
    assert (moved[1:] < 0.01).all()
