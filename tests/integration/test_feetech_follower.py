"""`ibrobot launch` on an emulated servo bus: torque when processes end, servos that die, coming to rest, startup."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import attrs
import pytest
from ibrobot_feetech.emulator import Emulator

from ibrobot_core.calibration import Calibration, JointCalibration, save_calibration

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("prompt_threads")]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PATIENCE_S = 30.0


@attrs.define
class Bench:
    """An emulated arm and what runs it."""

    emulator: Emulator
    folder: Path
    ibrobot: tuple[str, ...]
    run: subprocess.Popen[str] | None = None

    def launch(self, *arguments: str) -> subprocess.Popen[str]:
        """Run the arm in a mode in which nothing moves it."""
        joints = "".join(
            f"    - {{name: {name}, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}\n"
            for name in JOINTS
        )
        (self.folder / "arm.yaml").write_text(
            f"robot:\n  name: arm\n  joints:\n{joints}  groups: {{all: [{', '.join(JOINTS)}]}}\n"
            "  description: {poses: {up: [0.4, 0, 0, 0, 0, 0], far: [1.4, 0, 0, 0, 0, 0]}}\n"
            f"hardware: {{type: feetech_so101, port: {self.emulator.port}, calibration: {self.folder}/arm.json, "
            "anchored: [], lost_replies: 25}\n"
            "executors: {position: {type: position, group: all}}\n"
            "control_modes: {idle: {executors: [position]}}\ndefault_control_mode: idle\n"
            "control: {state_timeout: 1.0}\n"
        )
        command = [*self.ibrobot, "launch", str(self.folder / "arm.yaml"), "--headless", "--json", *arguments]
        self.run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.until(lambda: all(servo.torque for servo in self.emulator.servos.values()), "torque is on")
        return self.run

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with self.emulator.lock:
                if condition():
                    return
            assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:.0f} s"
            time.sleep(0.005)

    def until_quiet(self) -> None:
        """Nobody uses the bus any more."""
        requests = [0]
        self.emulator.on_request = lambda: requests.append(0)
        while True:
            seen = len(requests)
            time.sleep(0.2)
            if len(requests) == seen:
                return

    def torque(self) -> list[bool]:
        with self.emulator.lock:
            return [servo.torque for servo in self.emulator.servos.values()]


@pytest.fixture
def bench(tmp_path: Path, ibrobot: tuple[str, ...]) -> Iterator[Bench]:
    joints = {name: JointCalibration(i, 0, 0, 1000, 3100) for i, name in enumerate(JOINTS, 1)}
    save_calibration(Calibration(joints), tmp_path / "arm.json")
    with Emulator(6) as emulator:
        for servo in emulator.servos.values():
            servo.set("min_position_limit", 1000)
            servo.set("max_position_limit", 3100)
        bench = Bench(emulator, tmp_path, ibrobot)
        yield bench
        if bench.run is not None:
            bench.run.kill()
            bench.run.communicate()
            bench.until_quiet()


@pytest.mark.parametrize(("stop", "torque"), [("relax", False), ("hold", True)])
def test_a_killed_host_leaves_the_torque_as_configured(bench: Bench, stop: str, torque: bool) -> None:
    run = bench.launch("--set", f"control.stop={stop}")
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    bench.until_quiet()
    assert bench.torque() == [torque] * 6


@pytest.mark.parametrize(("stop", "torque"), [("relax", False), ("hold", True)])
def test_so_does_ctrl_c(bench: Bench, stop: str, torque: bool) -> None:
    run = bench.launch("--set", f"control.stop={stop}")
    time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, err
    assert bench.torque() == [torque] * 6
    counts = json.loads(out.splitlines()[-1])["counters"]["hardware"]["hardware"]
    assert counts["requests"] > 0
    assert counts["retries"] == counts["implausible_positions"] == 0


def test_a_servo_that_dies_is_named_and_the_others_hold(bench: Bench) -> None:
    run = bench.launch("--duration", "3")
    time.sleep(0.3)
    bench.emulator.faults.silent.add(3)
    out, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert "servo 3 (elbow_flex), present_position: no good reply for 26 ticks" in err
    assert "the robot holds" in err
    (fault,) = json.loads(out.splitlines()[-1])["faults"]
    assert fault.startswith(f"{bench.emulator.port}, servo 3 (elbow_flex)")
    assert [on for i, on in enumerate(bench.torque()) if i != 2] == [True] * 5


def test_a_servo_that_overloads_relaxes_the_arm_where_that_is_configured(bench: Bench) -> None:
    run = bench.launch("--duration", "3", "--set", "control.stop=relax")
    time.sleep(0.3)
    bench.emulator.faults.errors[5] = 0x20
    _, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert "servo 5 (wrist_roll), status: the servo reports overload" in err
    assert bench.torque() == [False] * 6


def test_startup_goes_slowly_to_a_pose_before_the_mode_begins(bench: Bench) -> None:
    goals: list[int] = []
    servo = bench.emulator.servos[1]
    bench.emulator.on_request = lambda: goals.append(servo.get("goal_position"))
    run = bench.launch("--duration", "0.5", "--set", "control.startup=pose up")
    _, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, err
    target = 2048 + round(0.4 * 4096 / 6.283185307)
    assert abs(goals[-1] - target) <= 1
    steps = [b - a for a, b in itertools.pairwise(goals)]
    slowly = 0.25 * 3.0 * 0.01 * 4096 / 6.283185307
    assert max(steps) <= 2 * slowly + 1


def test_ctrl_c_on_the_way_to_the_startup_pose_stops_there(bench: Bench) -> None:
    run = bench.launch("--set", "control.startup=pose far")
    run.send_signal(signal.SIGINT)
    _, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, err
    with bench.emulator.lock:
        goal = bench.emulator.servos[1].get("goal_position")
    assert goal < 2048 + 1.3 * 4096 / 6.283185307


def test_a_killed_control_process_leaves_the_torque_on_and_the_host_says_what_takes_it_off(bench: Bench) -> None:
    run = bench.launch()
    time.sleep(0.5)
    (control,) = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    os.kill(int(control), signal.SIGKILL)
    _, err = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 1
    assert "(signal 9); if joints still hold, `ibrobot feetech torque off` takes their torque off" in err
    assert bench.torque() == [True] * 6
