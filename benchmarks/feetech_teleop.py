"""Teleoperation over two emulated servo buses: tracking error, and latency from leader to goal register to follower.

A joint of the leader swings as a sine; `ibrobot launch` runs as a user runs it, and the emulators note where leader,
the follower's goal and the follower itself are. A sine fitted to each gives its delay.

    python benchmarks/feetech_teleop.py --duration 20 --throttle
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from numpy.typing import NDArray

from ibrobot_core.calibration import Calibration, JointCalibration

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""
LAUNCH = (sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", "launch", "so101_blind")
SETTLED_S = 2.0
"""From the first motion of the goals until the robot follows directly."""


def arm(folder: Path, name: str, *, throttle: bool) -> tuple[Emulator, Path]:
    """An emulated arm at zero, and its calibration."""
    joints = {joint: JointCalibration(i + 1, 0, 0, 700, 3400) for i, joint in enumerate(JOINTS)}
    emulator = Emulator(6, link=folder / name, throttle=throttle)
    for servo in emulator.servos.values():
        servo.set("min_position_limit", 700)
        servo.set("max_position_limit", 3400)
    return emulator, save_calibration(Calibration(joints), folder / f"{name}.json")


def swing(
    leader: Emulator, follower: Emulator, arguments: argparse.Namespace, end: threading.Event
) -> NDArray[np.float64]:
    """Swing the leader's pan until `end`; time [s], leader, goal and follower [rad], shape (N, 4)."""
    rows = []
    begun = time.monotonic()
    while not end.wait(0.004):
        now = time.monotonic() - begun
        angle = arguments.amplitude * math.sin(2 * math.pi * arguments.frequency * now)
        with leader.lock:
            leader.servos[1].turn(2048 + angle * RADIAN)
        follower.settle()
        with follower.lock:
            servo = follower.servos[1]
            if servo.torque:
                goal, reached = servo.get("goal_position"), servo.encoder
                rows.append((now, angle, (goal - 2048) / RADIAN, (reached - 2048) / RADIAN))
    return np.array(rows)


def sine(times: NDArray[np.float64], values: NDArray[np.float64], frequency: float) -> tuple[float, float]:
    """Amplitude and delay [s] of the sine in `values`."""
    phase = 2 * math.pi * frequency * times
    design = np.stack([np.sin(phase), np.cos(phase), np.ones_like(phase)], axis=1)
    (a, b, _), *_ = np.linalg.lstsq(design, values, rcond=None)
    return math.hypot(a, b), math.atan2(-b, a) / (2 * math.pi * frequency)


def main() -> None:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=20.0, help="of the run [s]")
    parser.add_argument("--frequency", type=float, default=0.5, help="of the leader's sine [Hz]")
    parser.add_argument("--amplitude", type=float, default=0.4, help="of the leader's sine [rad]")
    parser.add_argument("--rate", type=float, default=100.0, help="of the control loop [Hz]")
    parser.add_argument("--throttle", action="store_true", help="bytes take the time that they take at 1 Mbaud")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        leader, leader_file = arm(folder, "leader", throttle=arguments.throttle)
        follower, follower_file = arm(folder, "follower", throttle=arguments.throttle)
        sections = (
            f"hardware={{type: feetech_so101, port: {folder}/follower, calibration: {follower_file}}}",
            f"teleoperation.leader={{type: so101_leader, port: {folder}/leader, calibration: {leader_file}, "
            "deadman: none}",
            "control_modes.teleop.teleop=leader",
            f"control.rate_hz={arguments.rate}",
        )
        command = [*LAUNCH, "--mode", "teleop", "--headless", "--json", "--duration", str(arguments.duration)]
        command += [word for section in sections for word in ("--set", section)]
        with leader, follower:
            end = threading.Event()
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            found: list[NDArray[np.float64]] = []
            thread = threading.Thread(target=lambda: found.append(swing(leader, follower, arguments, end)))
            thread.start()
            output, _ = process.communicate()
            end.set()
            thread.join()
    report(found[0], json.loads(output.splitlines()[-1]), arguments)


def report(rows: NDArray[np.float64], summary: dict[str, object], arguments: argparse.Namespace) -> None:
    """Print the figures of the time in which the robot followed."""
    moving = np.flatnonzero(np.abs(np.diff(rows[:, 2])) > 0)
    begin, end = rows[moving[0], 0] + SETTLED_S, rows[moving[-1], 0] - 0.5
    times, leader, goal, follower = rows[(rows[:, 0] > begin) & (rows[:, 0] < end)].T
    fits = {
        name: sine(times, values, arguments.frequency)
        for name, values in (("leader", leader), ("goal", goal), ("follower", follower))
    }
    error = leader - follower
    delay = fits["follower"][1] - fits["leader"][1]
    aligned = np.interp(times - delay, times, leader) - follower
    wire = "throttled to 1 Mbaud" if arguments.throttle else "unthrottled"
    swung = f"sine of {arguments.frequency} Hz, {arguments.amplitude} rad"
    print(f"{swung}; control at {arguments.rate:g} Hz; {wire}; {times[-1] - times[0]:.1f} s")
    print(f"leader -> goal register   {1e3 * (fits['goal'][1] - fits['leader'][1]):6.1f} ms")
    print(f"goal register -> follower {1e3 * (fits['follower'][1] - fits['goal'][1]):6.1f} ms")
    print(f"leader -> follower        {1e3 * delay:6.1f} ms, amplitude x {fits['follower'][0] / fits['leader'][0]:.3f}")
    rms, worst = np.sqrt(np.mean(error**2)), np.abs(error).max()
    print(f"tracking error            {1e3 * rms:6.1f} mrad rms, {1e3 * worst:.1f} max")
    print(f"  after the delay         {1e3 * np.sqrt(np.mean(aligned**2)):6.1f} mrad rms")
    print(f"faults {summary['faults']}, loop {summary['loop']}")


if __name__ == "__main__":
    main()
