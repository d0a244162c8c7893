"""`ibrobot launch` on an emulated servo bus: torque when processes end, servos that die, coming to rest, startup."""

from __future__ import annotations

import itertools
import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import attrs
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from noting import Noting

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("prompt_threads")]

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PATIENCE_S = 60.0
TICK_S = 0.01
RADIAN = 4096 / 6.283185307
"""Ticks."""


@attrs.define
class Bench:
    """An emulated arm and what runs it."""

    emulator: Emulator
    folder: Path
    ibrobot: tuple[str, ...]
    run: subprocess.Popen[str] | None = None
    control: int = 0
    """Its process id."""
    ended: int = -1
    """A descriptor that can be read once the control process has ended."""

    def write(self, max_velocity: float = 3.0) -> None:
        """Write the YAML of an arm with a mode in which nothing moves it."""
        joints = "".join(
            f"    - {{name: {name}, lower: -1.5, upper: 1.5, max_velocity: {max_velocity}, max_acceleration: 40.0}}\n"
            for name in JOINTS
        )
        # A busy machine may keep the emulator, a thread of this process, from answering for a while.
        (self.folder / "arm.yaml").write_text(
            f"robot:\n  name: arm\n  joints:\n{joints}  groups: {{all: [{', '.join(JOINTS)}]}}\n"
            "  description: {poses: {up: [0.4, 0, 0, 0, 0, 0], far: [1.4, 0, 0, 0, 0, 0]}}\n"
            f"hardware: {{type: feetech_so101, port: {self.emulator.port}, calibration: {self.folder}/arm.json, "
            "anchored: [], lost_replies: 200, retries: 200}\n"
            "executors: {position: {type: position, group: all}}\n"
            "control_modes: {idle: {executors: [position]}}\ndefault_control_mode: idle\n"
            "control: {state_timeout: 20.0}\n"
        )

    def launch(self, *arguments: str, max_velocity: float = 3.0) -> subprocess.Popen[str]:
        """Run the arm."""
        self.write(max_velocity)
        command = [*self.ibrobot, "launch", str(self.folder / "arm.yaml"), "--headless", "--json", *arguments]
        with (self.folder / "out").open("w") as out, (self.folder / "err").open("w") as err:
            self.run = subprocess.Popen(command, stdout=out, stderr=err, text=True)
        self.until(lambda: all(servo.torque for servo in self.emulator.servos.values()), "torque is on")
        (control,) = Path(f"/proc/{self.run.pid}/task/{self.run.pid}/children").read_text().split()
        self.control, self.ended = int(control), os.pidfd_open(int(control))
        return self.run

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with self.emulator.lock:
                if condition():
                    return
            assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:.0f} s; {self.said}"
            time.sleep(0.005)

    @property
    def said(self) -> tuple[str, str]:
        """On standard output and standard error, so far."""
        return (self.folder / "out").read_text(), (self.folder / "err").read_text()

    def until_it_runs(self) -> None:
        """The host shows its mode: nothing is starting any more."""
        self.until(lambda: "mode idle | loop" in "".join(self.said), "the run has begun")

    def end(self) -> tuple[str, str]:
        """Wait until host and control process have ended; what the host said."""
        assert self.run is not None
        self.run.wait(PATIENCE_S)
        assert select.select([self.ended], [], [], PATIENCE_S)[0], "the control process is still there"
        return self.said

    def torque(self) -> list[bool]:
        with self.emulator.lock:
            return [servo.torque for servo in self.emulator.servos.values()]


@pytest.fixture
def bench(tmp_path: Path, ibrobot: tuple[str, ...]) -> Iterator[Bench]:
    joints = {name: JointCalibration(i, 0, 0, 1000, 3100) for i, name in enumerate(JOINTS, 1)}
    save_calibration(Calibration(joints), tmp_path / "arm.json")
    with Emulator({number: Noting(number) for number in range(1, 7)}) as emulator:
        for servo in emulator.servos.values():
            servo.set("min_position_limit", 1000)
            servo.set("max_position_limit", 3100)
        bench = Bench(emulator, tmp_path, ibrobot)
        yield bench
        if bench.run is not None:
            bench.run.kill()
            bench.run.wait()
        if bench.ended >= 0:
            gone = select.select([bench.ended], [], [], PATIENCE_S)[0]
            os.close(bench.ended)
            assert gone, "the control process is still there"


@pytest.mark.parametrize(("stop", "torque"), [("relax", False), ("hold", True)])
def test_a_killed_host_leaves_the_torque_as_configured(bench: Bench, stop: str, torque: bool) -> None:
    run = bench.launch("--set", f"control.stop={stop}")
    bench.until_it_runs()  # a start that fails takes its torque off
    run.kill()
    bench.end()
    assert bench.torque() == [torque] * 6


@pytest.mark.parametrize(("stop", "torque"), [("relax", False), ("hold", True)])
def test_so_does_ctrl_c(bench: Bench, stop: str, torque: bool) -> None:
    run = bench.launch("--set", f"control.stop={stop}")
    bench.until_it_runs()
    run.send_signal(signal.SIGINT)
    out, err = bench.end()
    assert run.returncode == 0, err
    assert bench.torque() == [torque] * 6
    counts = json.loads(out.splitlines()[-1])["counters"]["hardware"]["hardware"]
    assert counts["requests"] > 0
    assert counts["bad_packets"] == counts["implausible_positions"] == 0
    assert counts["retries"] <= counts["timeouts"], "nothing was sent again but what this machine was too slow for"
    assert (f"to take it off: `ibrobot feetech torque off {bench.emulator.port}`" in err) == torque


def test_a_leader_that_is_missing_ends_the_start_and_leaves_no_torque_on(bench: Bench) -> None:
    leader = (
        f"{{type: so101_leader, port: {bench.folder}/unplugged, calibration: {bench.folder}/arm.json, deadman: none}}"
    )
    run = bench.launch("--set", f"teleoperation.leader={leader}", "--set", "control_modes.idle.teleop=leader")
    _, err = bench.end()
    assert run.returncode == 1
    assert f"{bench.folder}/unplugged: there is no such port" in err
    assert bench.torque() == [False] * 6
    assert "holds torque" not in err


def test_the_same_port_given_twice_is_refused_before_power_up(bench: Bench, tmp_path: Path) -> None:
    arm = f"port: {bench.emulator.port}, calibration: {bench.folder}/arm.json"
    bench.write()
    command = [*bench.ibrobot, "launch", str(tmp_path / "arm.yaml"), "--headless"]
    leader = ["--set", f"teleoperation.leader={{type: so101_leader, {arm}}}"]
    ran = subprocess.run([*command, *leader], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ran.returncode == 2
    assert f"teleoperation.leader.port: {bench.emulator.port} is already used by hardware" in ran.stderr
    assert bench.torque() == [False] * 6


def test_a_servo_that_dies_is_named_and_the_others_hold(bench: Bench) -> None:
    run = bench.launch()
    bench.until_it_runs()
    bench.emulator.faults.silent.add(3)
    bench.until(lambda: "the robot holds" in bench.said[1], "a fault")
    run.send_signal(signal.SIGINT)
    out, err = bench.end()
    assert run.returncode == 1
    assert "servo 3 (elbow_flex), present_position: no valid reply for 201 ticks" in err
    (fault,) = json.loads(out.splitlines()[-1])["faults"]
    assert fault.startswith(f"{bench.emulator.port}, servo 3 (elbow_flex)")
    assert [on for i, on in enumerate(bench.torque()) if i != 2] == [True] * 5


def test_a_servo_that_overloads_relaxes_the_arm_where_that_is_configured(bench: Bench) -> None:
    run = bench.launch("--set", "control.stop=relax")
    bench.until_it_runs()
    bench.emulator.faults.errors[5] = 0x20
    bench.until(lambda: "fault: " in bench.said[1], "a fault")
    run.send_signal(signal.SIGINT)
    _, err = bench.end()
    assert run.returncode == 1
    assert "servo 5 (wrist_roll): the servo reports overload" in err
    assert bench.torque() == [False] * 6


def test_startup_goes_slowly_to_a_pose_before_the_mode_begins(bench: Bench) -> None:
    run = bench.launch("--duration", "0.5", "--set", "control.startup=pose up")
    _, err = bench.end()
    assert run.returncode == 0, err
    servo = bench.emulator.servos[1]
    assert isinstance(servo, Noting)
    # The mode then holds the measured position, to which a busy machine's emulator may not have brought it all the way.
    assert abs(max(servo.goals) - (2048 + round(0.4 * RADIAN))) <= 1
    steps = [b - a for a, b in itertools.pairwise(servo.goals)]
    assert max(steps) <= 0.25 * 3.0 * TICK_S * RADIAN + 1


def test_ctrl_c_on_the_way_to_the_startup_pose_stops_there(bench: Bench) -> None:
    run = bench.launch("--set", "control.startup=pose far", max_velocity=0.3)  # it is on its way for long
    run.send_signal(signal.SIGINT)
    _, err = bench.end()
    assert run.returncode == 130, err
    with bench.emulator.lock:
        goal = bench.emulator.servos[1].get("goal_position")
    assert goal < 2048 + 1.3 * RADIAN


def test_a_killed_control_process_leaves_the_torque_on_and_the_host_says_what_takes_it_off(bench: Bench) -> None:
    run = bench.launch()
    bench.until_it_runs()
    os.kill(bench.control, signal.SIGKILL)
    _, err = bench.end()
    assert run.returncode == 1
    assert "(killed by SIGKILL); if joints still hold, `ibrobot feetech torque off` takes their torque off" in err
    assert bench.torque() == [True] * 6
