"""Runs of an emulated arm on whose bus everything fails, recorded and converted: no row has an old state."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import independent
import pytest
import yaml
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_mcap.reader import Rosbag2Reader

from ibrobot_core.contract.specs import Contract

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("prompt_threads", "first_conversion")]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PATIENCE_S = 300.0
MANY = 30
"""Messages of a phase of a run: longer than the greatest age."""
STATES, COMMANDS = "/joint_states", "/arm/commands"
OVERHEATING = 0x04
"""The error bit of a servo that is too hot."""
ROBOT = """
robot:
  name: arm
  joints:
{joints}
  groups: {{all: [{names}]}}
hardware: {{type: feetech_so101, port: {port}, calibration: {folder}/arm.json, anchored: [], {patience}}}
executors: {{position: {{type: position, group: all}}}}
control_modes: {{idle: {{executors: [position]}}}}
default_control_mode: idle
control: {{state_timeout: 60.0}}
recording: {{type: mcap, root: {folder}/kept, min_free: 0, chunk_period_s: 0.05, compression: none}}
contract:
  rate_hz: 30
  observations:
    - {{key: observation.state, topic: /joint_states, select: [{positions}], align: {{strategy: hold, stamp: header}}}}
  actions:
    - {{key: action, executor: position, topic: /arm/commands, type: std_msgs/msg/Float64MultiArray}}
"""


@attrs.define
class Bench:
    """An emulated arm, and the run that records it."""

    emulator: Emulator
    folder: Path
    run: subprocess.Popen[str]

    @property
    def bag(self) -> Path:
        return self.folder / "kept/default/episodes/episode_000001"

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.run.poll() is None, self.said()
            assert time.monotonic() < deadline, self.said()
            time.sleep(0.05)

    def count(self, topic: str) -> int:
        """Messages that are recorded so far."""
        if not list(self.bag.glob("*.mcap")):
            return 0
        reader = Rosbag2Reader(self.bag)
        try:
            found = reader.summary().topics.get(topic)
            return found.count if found is not None else 0
        finally:
            reader.close()

    def go_on(self, topic: str) -> None:
        """Until many more messages are recorded."""
        begin = self.count(topic)
        self.until(lambda: self.count(topic) > begin + MANY)

    def end(self) -> None:
        self.run.send_signal(signal.SIGINT)
        self.run.wait(PATIENCE_S)

    def said(self) -> str:
        return (self.folder / "err").read_text()


@pytest.fixture
def begin(tmp_path: Path, ibrobot: tuple[str, ...]) -> Iterator[Callable[[int], Bench]]:
    """Begin a run whose bus may lose so many replies in a row."""
    save_calibration(
        Calibration({name: JointCalibration(i, 0, 0, 1000, 3100) for i, name in enumerate(JOINTS, 1)}),
        tmp_path / "arm.json",
    )
    runs: list[Bench] = []
    with Emulator() as emulator:

        def started(lost: int) -> Bench:
            for servo in emulator.servos.values():
                servo.set("min_position_limit", 1000)
                servo.set("max_position_limit", 3100)
            joint = "    - {{name: {}, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}"
            text = ROBOT.format(
                joints="\n".join(map(joint.format, JOINTS)),
                names=", ".join(JOINTS),
                port=emulator.port,
                folder=tmp_path,
                patience=f"lost_replies: {lost}, retries: 200",
                positions=", ".join(f"position.{name}" for name in JOINTS),
            )
            (tmp_path / "arm.yaml").write_text(text)
            with (tmp_path / "err").open("w") as err:
                command = [*ibrobot, "launch", str(tmp_path / "arm.yaml"), "--headless"]
                runs.append(Bench(emulator, tmp_path, subprocess.Popen(command, stdout=err, stderr=err, text=True)))
            return runs[-1]

        yield started
        for bench in runs:
            bench.run.kill()
            bench.run.wait()


def compared(bench: Bench) -> tuple[int, list[frozenset[str]], str]:
    """Gaps of the state, what is missing at each tick, and what verify says; all agree with an independent reading."""
    document = yaml.safe_load((bench.bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    contract = Contract.from_canonical(json.loads(document["custom_data"]["contract"]))
    read = independent.samples(bench.bag, contract)
    stamps = [each.stamp_ns for each in read[STATES]]
    assert stamps == sorted(set(stamps)), "no state is repeated"
    assert len(read[COMMANDS]) >= len(stamps) > MANY, "commands go on"
    lost, verified = independent.check(bench.bag, bench.folder / "set", contract)
    return lost.get("observation.state", 0), independent.missing(read, contract), verified


def test_replies_that_fail_for_a_time_are_gaps(begin: Callable[[int], Bench]) -> None:
    bench = begin(1_000_000)
    bench.go_on(STATES)
    faults = bench.emulator.faults
    passing: list[dict[str, Any]] = [
        {"silent": {2}},
        {"drop": 1.0},
        {"corrupt": 1.0},
        {"late": 1.0, "late_s": 0.05},
        {"delay_s": 0.05},
        {"drop": 0.2, "corrupt": 0.002, "duplicate": 0.2},
    ]
    for fault in passing:
        before = {name: getattr(faults, name) for name in fault}
        for name, value in fault.items():
            setattr(faults, name, value)
        bench.go_on(COMMANDS)
        for name, value in before.items():
            setattr(faults, name, value)
        bench.go_on(STATES)
    bench.end()
    lost, _, verified = compared(bench)
    assert lost >= 5, "a servo without a voice, and no, damaged, late and slow replies"
    assert f"{STATES}: nothing new for " in verified


@pytest.mark.parametrize("fault", ["disconnected", pytest.param("unplugged", marks=pytest.mark.long)])
def test_an_arm_that_is_gone_is_missing_to_the_end(begin: Callable[[int], Bench], fault: str) -> None:
    bench = begin(200)
    bench.go_on(STATES)
    if fault == "unplugged":
        bench.emulator.unplug()
    else:
        bench.emulator.faults.disconnected.add(3)
    bench.until(lambda: "fault: " in bench.said())
    bench.go_on(COMMANDS)
    bench.end()
    lost, ticks, verified = compared(bench)
    assert lost >= 1
    assert set(ticks[-5:]) == {frozenset({"observation.state"})}
    assert f"{STATES}: " in verified


def test_a_servo_that_lost_its_power_for_a_moment_is_measured_again(begin: Callable[[int], Bench]) -> None:
    bench = begin(200)
    bench.go_on(STATES)
    bench.emulator.faults.brown_out.add(3)
    bench.until(lambda: "fault: " in bench.said())
    bench.go_on(STATES)
    bench.end()
    compared(bench)


@pytest.mark.parametrize("fault", ["error", pytest.param("overloaded", marks=pytest.mark.long)])
def test_a_servo_that_reports_an_error_gives_no_old_state(begin: Callable[[int], Bench], fault: str) -> None:
    bench = begin(200)
    bench.go_on(STATES)
    if fault == "error":
        bench.emulator.faults.errors[3] = OVERHEATING
    else:
        bench.emulator.faults.overloaded.add(3)
    bench.until(lambda: "fault: " in bench.said())
    bench.go_on(COMMANDS)
    bench.end()
    compared(bench)
