"""LeRobot's so101_follower in a device process beside our own driver, on the same emulated bus.

    python benchmarks/lerobot_devices.py [--seconds 10]

Needs `lerobot[feetech]`. The arm follows a sine at 100 Hz by each driver. Prints how long a tick waits for a reading,
the age of readings, the delay of the motion behind its command, and processor time; then how long it takes until a
blocked call, an unplugged bus and a bus with nothing but garbage are a fault, with its text. Exits with 1 if a fault
takes more than 0.3 s, if one is not named, or if the arm's goals change afterwards.
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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.follower import FeetechFollower
from ibrobot_feetech.options import FollowerOptions
from ibrobot_lerobot_devices.hardware import LeRobotHardware
from ibrobot_lerobot_devices.options import RobotOptions
from ibrobot_testing.contexts import control_context

from ibrobot_core.api import Calibration, Hardware, HardwareError, JointCalibration, RealClock, ns
from ibrobot_core.app import go_real_time

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
CALIBRATION = {name: JointCalibration(i, 0, 0, 700, 3300) for i, name in enumerate(JOINTS, 1)}
PERIOD_S, AMPLITUDE, FREQUENCY_HZ = 0.01, 0.3, 0.5
LONGEST_S, TIMEOUT_S = 0.3, 5.0
EMULATOR = """
import json, sys
from ibrobot_feetech.emulator import Emulator
from ibrobot_core.app import go_real_time
with Emulator(throttle=True) as emulator:
    for servo, registers in json.loads(sys.argv[1]).items():
        for name, value in registers.items():
            emulator.servos[int(servo)].set(name, value)
    go_real_time(70)
    print(emulator.port, flush=True)
    for line in sys.stdin:
        what = line.strip()
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


@contextmanager
def emulated() -> Iterator[Bus]:
    """A bus of servos that have the calibration."""
    registers = {
        joint.id: {"min_position_limit": joint.range_min, "max_position_limit": joint.range_max}
        for joint in CALIBRATION.values()
    }
    command = [sys.executable, "-c", EMULATOR, json.dumps(registers)]
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


def made(config: Mapping[str, str], clock: RealClock, **options: Any) -> LeRobotHardware:
    """A connected arm of LeRobot's."""
    arm = LeRobotHardware(RobotOptions("so101_follower", config, **options), control_context("lerobot", clock=clock))
    for left in reversed(range(30)):  # LeRobot writes once, and waits 50 ms for the answer
        try:
            arm.connect()
            break
        except HardwareError:
            if not left:
                raise
    return arm


def process(arm: LeRobotHardware) -> int:
    """The id of its device process."""
    assert arm._link.pid is not None
    return arm._link.pid


def fault(arm: LeRobotHardware, bus: Bus, clock: RealClock, what: str) -> tuple[float, str, bool]:
    """Time until a fault [s], its text, and whether the servos' goals stayed as they were."""
    for _ in range(50):
        clock.sleep_until(clock.now_ns() + ns(PERIOD_S))
        arm.read()
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
    clock, good = RealClock(), True
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
            print(f"{name}: a fault after {took_s:.2f} s, goals {'kept' if kept else 'CHANGED'}: {text[:110]}")
            theirs.disconnect()
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
