"""LeRobot's so101_follower and so101_leader in device processes beside our own drivers, on the same emulated bus.

    python benchmarks/lerobot_devices.py [--seconds 10]

Needs `lerobot[feetech]`. The arm follows a sine at 100 Hz by each driver. Prints how long a tick waits for a reading,
the age of readings, the delay of the motion behind its command, and processor time; then how long it takes until a
blocked call, an unplugged bus and a bus with nothing but garbage are a fault, with its text. Then a hand swings the
leader: prints amplitude and delay of what the robot would follow, how long a tick waits, its lateness, missed ticks and
processor time. Exits with 1 if a fault takes more than 0.3 s, is not named or has the text of another, if the arm's
goals change afterwards, or if the leader's readings differ by more than two ticks.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.follower import FeetechFollower
from ibrobot_feetech.leader import LeaderTeleop
from ibrobot_feetech.options import FollowerOptions, LeaderOptions
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.options import RobotOptions, TeleopOptions
from ibrobot_lerobot_devices.teleop import LeRobotTeleop
from ibrobot_testing.contexts import control_context, host_context

from ibrobot_core.api import (
    Calibration,
    Hardware,
    HardwareError,
    JointCalibration,
    JointReading,
    RealClock,
    Teleop,
    TeleopError,
    nan_vector,
    ns,
)
from ibrobot_core.app import begin_operation, go_real_time, operate

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
CALIBRATION = {name: JointCalibration(i, 0, 0, 700, 3300) for i, name in enumerate(JOINTS, 1)}
PERIOD_S, AMPLITUDE, FREQUENCY_HZ = 0.01, 0.3, 0.5
LONGEST_S, TIMEOUT_S, APPROACH_S = 0.3, 5.0, 1.5
EMULATOR = """
import json, math, sys, threading, time
from ibrobot_feetech.emulator import Emulator
from ibrobot_core.app import go_real_time
with Emulator(throttle=True) as emulator:
    for servo, registers in json.loads(sys.argv[1]).items():
        for name, value in registers.items():
            emulator.servos[int(servo)].set(name, value)
    go_real_time(70)
    print(emulator.port, flush=True)
    def swing(begun_s):
        while True:
            time.sleep(0.004)
            angle = float(sys.argv[2]) * math.sin(2 * math.pi * float(sys.argv[3]) * (time.monotonic() - begun_s))
            with emulator.lock:
                if not emulator.servos[1].torque:
                    emulator.servos[1].turn(2048 + angle * 4096 / (2 * math.pi))
    for line in sys.stdin:
        what = line.strip()
        if what == "swing":
            begun_s = time.monotonic()
            threading.Thread(target=swing, args=(begun_s,), daemon=True).start()
            print(json.dumps(begun_s), flush=True)
            continue
        emulator.faults.silent = set(range(1, 7)) if what == "unplug" else set()
        emulator.faults.corrupt = 1.0 if what == "garbage" else 0.0
        print(json.dumps([servo.get("goal_position") for servo in emulator.servos.values()]), flush=True)
"""


class Bus:
    """The emulated bus, in a process of its own, as a real one is beside the computer."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self._input, self._output = process.stdin, process.stdout
        self.port = self._output.readline().strip()

    def suffer(self, what: str = "") -> list[int]:
        """Set a fault, or none; returns the servos' goals [ticks]."""
        print(what, file=self._input, flush=True)
        goals: list[int] = json.loads(self._output.readline())
        return goals

    def swing(self) -> float:
        """Let a hand swing the first joint as a sine from now on; returns the monotonic time of its begin [s]."""
        print("swing", file=self._input, flush=True)
        begun_s: float = json.loads(self._output.readline())
        return begun_s


@contextmanager
def emulated() -> Iterator[Bus]:
    """A bus of servos that have the calibration."""
    registers = {
        joint.id: {"min_position_limit": joint.range_min, "max_position_limit": joint.range_max}
        for joint in CALIBRATION.values()
    }
    command = [sys.executable, "-c", EMULATOR, json.dumps(registers), str(AMPLITUDE), str(FREQUENCY_HZ)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Bus(process)
        finally:
            process.terminate()


def cpu_s(pid: int | None) -> float:
    """Processor time of this process and of another one [s]."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    spent = own.ru_utime + own.ru_stime
    if pid is not None:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        spent += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return spent


def follow(hardware: Hardware, clock: RealClock, seconds: float, pid: int | None) -> str:
    """Follow a sine, and return the figures in one line."""
    start = hardware.read().position.copy()
    begun_ns, begun_cpu_s = clock.now_ns(), cpu_s(pid)
    waits, ages, stale, commands, positions = [], [], 0, [], []
    ticks = round(seconds / PERIOD_S)
    for tick in range(ticks):
        clock.sleep_until(begun_ns + ns(tick * PERIOD_S))
        at_s = time.perf_counter()
        reading = hardware.read()
        waits.append(time.perf_counter() - at_s)
        ages.append(clock.now_ns() - reading.stamp_ns)
        stale += reading.stale
        goal = start + AMPLITUDE * math.sin(2 * math.pi * FREQUENCY_HZ * tick * PERIOD_S)
        hardware.write(goal)
        commands.append(goal[0])
        positions.append(reading.position[0])
    spent = (cpu_s(pid) - begun_cpu_s) / seconds
    lags = range(30)
    away = [np.abs(np.array(positions[30:]) - np.array(commands)[30 - lag : ticks - lag]).mean() for lag in lags]
    wait, age = (np.percentile(np.array(each), (50, 99)) for each in (waits, ages))
    return (
        f"waits {wait[0] * 1e3:.2f} ms (p99 {wait[1] * 1e3:.2f}), age {age[0] / 1e6:.2f} ms (p99 {age[1] / 1e6:.2f}), "
        f"stale {stale}/{ticks}, delay {int(np.argmin(away)) * PERIOD_S * 1e3:.0f} ms, processor {100 * spent:.0f} %"
    )


def lead(device: Teleop, clock: RealClock, seconds: float, swing_s: float, pid: int | None) -> tuple[str, float, float]:
    """Follow a leader that swings since `swing_s`; figures in one line, amplitude and middle of the motion [rad]."""
    at = np.zeros(len(JOINTS))
    begin_operation(device, JointReading(clock.now_ns(), at, np.zeros_like(at), nan_vector(len(at))))
    begun_ns, begun_cpu_s = clock.now_ns(), cpu_s(pid)
    waits, late, rows = [], [], []
    for tick in range(round(seconds / PERIOD_S)):
        due_ns = begun_ns + ns(tick * PERIOD_S)
        clock.sleep_until(due_ns)
        now_ns, now_s = clock.now_ns(), time.monotonic()
        late.append(now_ns - due_ns)
        command = operate(device, JointReading(now_ns, at.copy(), np.zeros_like(at), nan_vector(len(at))))
        waits.append(time.monotonic() - now_s)
        for name, position in (command.positions or {}).items():
            at[JOINTS.index(name)] = position
        if tick * PERIOD_S > APPROACH_S:
            rows.append((now_s - swing_s, at[0]))
    spent = (cpu_s(pid) - begun_cpu_s) / seconds
    times, angles = np.array(rows).T
    phase = 2 * np.pi * FREQUENCY_HZ * times
    (a, b, middle), *_ = np.linalg.lstsq(np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], 1), angles)
    amplitude, delay_s = math.hypot(a, b), math.atan2(-b, a) / (2 * math.pi * FREQUENCY_HZ)
    wait, lateness = (np.percentile(np.array(each), (50, 99)) for each in (waits, late))
    missed = sum(each > ns(PERIOD_S) for each in late)
    text = (
        f"amplitude {amplitude:.4f} rad, delay {1e3 * delay_s:.1f} ms, waits {1e3 * wait[0]:.2f} ms "
        f"(p99 {1e3 * wait[1]:.2f}), late {lateness[0] / 1e6:.2f} ms (p99 {lateness[1] / 1e6:.2f}), "
        f"missed {missed}/{len(late)}, processor {100 * spent:.0f} %"
    )
    return text, amplitude, middle


def leaders(folder: str, clock: RealClock, seconds: float) -> bool:
    """Our leader driver and LeRobot's, in turn, on one bus; whether their readings are the same."""
    found = []
    with emulated() as bus:
        path, swing_s = str(Path(folder) / "arm.json"), bus.swing()
        own = LeaderTeleop(
            LeaderOptions(bus.port, path, deadman="none", ramp_velocity=3.0), host_context("ours", clock=clock)
        )
        config = {"port": bus.port, "id": "arm", "calibration_dir": folder}
        options = TeleopOptions(
            "so101_leader", config, deadman="none", ramp_velocity=3.0, blocked=5.0, lost_readings=1000
        )
        theirs = LeRobotTeleop(options, host_context("lerobot", clock=clock))
        for name, device in (("so101_leader", own), ("lerobot so101_leader", theirs)):
            patiently(device.connect, TeleopError)
            pid = theirs._link.pid if device is theirs else None
            text, *fit = lead(device, clock, seconds, swing_s, pid)
            device.disconnect()
            print(f"{name}: {text}")
            found.append(fit)
    away = float(np.abs(np.array(found[0]) - np.array(found[1])).max())
    print(f"readings differ by {away * 4096 / (2 * math.pi):.1f} ticks")
    return away <= 2 * 2 * math.pi / 4096


def patiently(connect: Callable[[], None], wrong: type[Exception]) -> None:
    """Connect; LeRobot writes once, and waits 50 ms for the answer."""
    for _ in range(30):
        with suppress(wrong):
            return connect()
    return connect()


def made(config: Mapping[str, str], clock: RealClock, **options: Any) -> LeRobotHardware:
    """A connected arm of LeRobot's."""
    arm = LeRobotHardware(RobotOptions("so101_follower", config, **options), control_context("lerobot", clock=clock))
    patiently(arm.connect, HardwareError)
    return arm


def process(arm: LeRobotHardware) -> int:
    """The id of its device process."""
    assert arm._link.pid is not None
    return arm._link.pid


def fault(arm: LeRobotHardware, bus: Bus, clock: RealClock, what: str) -> tuple[float, str, bool]:
    """Time until a fault [s], its text, and whether the servos' goals stayed as they were."""
    quiet = 0
    while quiet < 50:  # a busy machine may itself cause a fault
        clock.sleep_until(clock.now_ns() + ns(PERIOD_S))
        try:
            arm.read()
            quiet += 1
        except HardwareError:
            quiet = 0
            patiently(arm.reset_faults, HardwareError)
    before, pid = bus.suffer(), process(arm)
    if what == "blocked":
        os.kill(pid, signal.SIGSTOP)
    else:
        bus.suffer(what)
    begun_s = time.monotonic()
    try:
        while time.monotonic() - begun_s < TIMEOUT_S:
            clock.sleep_until(clock.now_ns() + ns(PERIOD_S))
            arm.read()
    except HardwareError as error:
        return time.monotonic() - begun_s, str(error), bus.suffer() == before
    finally:
        bus.suffer()
        os.kill(pid, signal.SIGCONT)
    return TIMEOUT_S, "no fault", False


def main() -> int:
    """Run; returns the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    clock, good, texts = RealClock(), True, []
    for refused in go_real_time(60):  # as the control process
        print(refused)
    with tempfile.TemporaryDirectory() as folder, emulated() as bus:
        save_calibration(Calibration(CALIBRATION), Path(folder) / "arm.json")
        ours = FeetechFollower(
            FollowerOptions(bus.port, str(Path(folder) / "arm.json"), lost_replies=1000),
            control_context("ours", clock=clock),
        )
        ours.connect()
        print("feetech_so101:", follow(ours, clock, arguments.seconds, None))
        ours.disconnect()
        config = {"port": bus.port, "id": "arm", "calibration_dir": folder}
        begun_s = time.monotonic()
        # On a busy machine a call may take longer than a fault allows: its time is in the figures.
        theirs = made(config, clock, blocked=5.0, lost_readings=1000)
        pid = process(theirs)
        status = Path(f"/proc/{pid}/status").read_text()
        memory = int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024
        print(f"lerobot: connected in {time.monotonic() - begun_s:.1f} s, {memory:.0f} MB")
        print("lerobot:", follow(theirs, clock, arguments.seconds, pid))
        theirs.disconnect()
        for name in ("blocked", "unplug", "garbage"):
            theirs = made(config, clock)
            took_s, text, kept = fault(theirs, bus, clock, name)
            good = good and took_s <= LONGEST_S and kept and "lerobot: " in text
            print(f"{name}: a fault after {took_s:.2f} s, goals {'kept' if kept else 'CHANGED'}: {text}")
            texts.append(text)
            theirs.disconnect()
        good = good and len(set(texts)) == len(texts)
        good = leaders(folder, clock, arguments.seconds) and good
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
