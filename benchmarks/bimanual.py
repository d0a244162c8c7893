"""Lateness of the control loop with two leaders and two followers, against one of each, in paired blocks.

    python benchmarks/bimanual.py [--blocks 5] [--seconds 8]

Each arm is an emulator in a process of its own, on a bus with the wire times of 1 Mbaud. `ibrobot launch` runs at
100 Hz as a user runs it: `bi_so101` with four arms, `so101_blind` with two. The leaders swing as a sine, the followers
follow. The two runs of a block come one after the other, in turns of order. Exits with 1 if one did not follow, if
the median ratio of p50 or p99 lateness is above 2, or if the bimanual runs missed more ticks.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

ALLOWED_RATIO = 2.0
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
LAUNCH = (sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", "launch")
RADIAN = 4096 / (2 * math.pi)
"""Ticks."""
AMPLITUDE, FREQUENCY_HZ = 0.3, 0.5
"""Of the leaders' sine [rad]."""
FOLLOWED = 0.4
"""Least way of a follower's pan between its ends that counts as followed [rad]."""
FOLLOWER_PRIORITY, LEADER_PRIORITY = 70, 50
"""Of the emulators. The control process has 60: followers answer it within a tick, leaders must not make it late."""
LOST_REPLIES = 20
"""A busy machine may keep an emulator from answering for some ticks."""
ATTEMPTS = 5
START_S = 15.0
"""Longest start of an emulator."""


def emulate(link: Path, prefix: str, *, leader: bool) -> None:
    """Be an arm until SIGTERM; a leader swings its pan. Prints the way of the pan between its ends [rad]."""
    from ibrobot_feetech.calibration import save_calibration
    from ibrobot_feetech.emulator import Emulator

    from ibrobot_core.api import Calibration, JointCalibration
    from ibrobot_core.app import go_real_time

    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    joints = {f"{prefix}{joint}": JointCalibration(i + 1, 0, 0, 700, 3400) for i, joint in enumerate(JOINTS)}
    with Emulator(6, link=link, throttle=True) as emulator:
        for servo in emulator.servos.values():
            servo.set("min_position_limit", 700)
            servo.set("max_position_limit", 3400)
        save_calibration(Calibration(joints), link.with_suffix(".json"))
        sys.setswitchinterval(2e-4)
        go_real_time(LEADER_PRIORITY if leader else FOLLOWER_PRIORITY)
        print("ready", flush=True)
        lowest, highest, begun = math.inf, -math.inf, time.monotonic()
        while not ended.wait(0.02):
            with emulator.lock:
                pan = emulator.servos[1]
                if leader:
                    turned = AMPLITUDE * math.sin(2 * math.pi * FREQUENCY_HZ * (time.monotonic() - begun))
                    pan.turn(2048 + turned * RADIAN)
                lowest, highest = min(lowest, pan.encoder), max(highest, pan.encoder)
    print((highest - lowest) / RADIAN, flush=True)


def run(folder: Path, sides: tuple[str, ...], seconds: float) -> dict[str, Any]:
    """The summary of a run with these arms, and the ways of the followers [rad]."""
    arms = {}
    environment = dict(os.environ)
    for side in sides:
        for kind in ("follower", "leader"):
            link = folder / f"{side}_{kind}"
            prefix = f"{side}_" if kind == "follower" and len(sides) > 1 else ""
            command = [sys.executable, __file__, "--emulate", str(link), "--prefix", prefix]
            arms[link] = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            environment[f"IBROBOT_{side.upper()}_{kind.upper()}_PORT"] = str(link)
            environment[f"IBROBOT_{side.upper()}_{kind.upper()}_CALIBRATION"] = str(link.with_suffix(".json"))
    try:
        for arm in arms.values():
            assert arm.stdout is not None
            assert arm.stdout.readline() == "ready\n"
        if len(sides) > 1:
            robot = "bi_so101"
            overrides = ["peripherals=[]", "contract.observations=[]"]
            overrides += [f"teleoperation.leader_{side}.deadman=none" for side in sides]
            overrides += [f"teleoperation.leader_{side}.lost_replies={LOST_REPLIES}" for side in sides]
            overrides += [f"hardware.{side}_follower.lost_replies={LOST_REPLIES}" for side in sides]
        else:
            robot, (side,) = "so101_blind", sides
            follower, leader = (folder / f"{side}_{kind}" for kind in ("follower", "leader"))
            lost = f"lost_replies: {LOST_REPLIES}"
            wiring = f"port: {leader}, calibration: {leader}.json, deadman: none, {lost}"
            overrides = [
                f"hardware={{type: feetech_so101, port: {follower}, calibration: {follower}.json, {lost}}}",
                f"teleoperation.leader={{type: so101_leader, {wiring}}}",
                "control_modes.teleop.teleop=leader",
            ]
        command = [*LAUNCH, robot, "--mode", "teleop", "--headless", "--json", "--duration", str(seconds)]
        command += [word for override in overrides for word in ("--set", override)]
        ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
        if ran.returncode:
            reasons = [line for line in ran.stderr.splitlines() if line.startswith(("E ", "error"))]
            raise RuntimeError(reasons[0] if reasons else ran.stderr)
        summary: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    finally:
        for arm in arms.values():
            arm.terminate()
        ways = {link.name: arm.communicate(timeout=START_S)[0] for link, arm in arms.items()}
    return summary | {"ways": {name: round(float(way), 2) for name, way in ways.items() if "follower" in name}}


def attempt(sides: tuple[str, ...], seconds: float) -> dict[str, Any]:
    """As `run`; again where the machine was too busy for the emulators to answer."""
    for _ in range(ATTEMPTS):
        try:
            with tempfile.TemporaryDirectory() as folder:
                return run(Path(folder), sides, seconds)
        except RuntimeError as error:
            print(f"again: {error}", flush=True)
    sys.exit(f"none of {ATTEMPTS} runs came to its end")


def main() -> int:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=5, help="pairs of runs")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run")
    parser.add_argument("--emulate", type=Path, metavar="LINK", help=argparse.SUPPRESS)
    parser.add_argument("--prefix", default="", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.emulate is not None:
        emulate(arguments.emulate, arguments.prefix, leader="leader" in arguments.emulate.name)
        return 0
    blocks: list[dict[str, dict[str, Any]]] = []
    kinds = {"one": ("left",), "two": ("left", "right")}
    followed = True
    for block in range(arguments.blocks):
        found = {}
        for name in sorted(kinds, reverse=block % 2 == 1):
            summary = attempt(kinds[name], arguments.seconds)
            found[name] = summary["loop"]
            followed &= all(way > FOLLOWED for way in summary["ways"].values()) and not summary["faults"]
            loop = found[name]
            print(
                f"{block + 1}  {name}  p50 {loop['lateness_p50_us']:5} us  p99 {loop['lateness_p99_us']:5} us  "
                f"missed {loop['missed']}  {summary['ways']} rad  faults {summary['faults']}",
                flush=True,
            )
        blocks.append(found)
    ratios = {
        key: statistics.median(block["two"][key] / max(1, block["one"][key]) for block in blocks)
        for key in ("lateness_p50_us", "lateness_p99_us")
    }
    missed = {name: sum(block[name]["missed"] for block in blocks) for name in kinds}
    failed = not followed or max(ratios.values()) > ALLOWED_RATIO or missed["two"] > missed["one"]
    print(
        f"two arms against one: p50 {ratios['lateness_p50_us']:.2f} times, p99 {ratios['lateness_p99_us']:.2f} times; "
        f"{missed['two']} and {missed['one']} ticks missed; "
        f"{'every follower followed' if followed else 'A FOLLOWER DID NOT FOLLOW'}"
    )
    print("FAILED" if failed else "passed")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
