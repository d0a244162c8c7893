"""Ten minutes of control over a bad servo bus: one byte in a hundred damaged, one reply in a hundred lost.

    python benchmarks/feetech_soak.py

The control loop (executors, safety layer, the driver) runs in stepped time, at 100 Hz, against emulated servos behind a
real pseudo-terminal, and follows a path; faults are reset as an operator would. Prints what was counted, and exits with
1 when a position was accepted that is further from the servo's true one than the driver's own bound, when a command
left the limits, or when something that the emulator did is in no counter.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator

from ibrobot_core.calibration import Calibration, JointCalibration
from ibrobot_core.clock import SteppedClock
from ibrobot_core.config import from_document
from ibrobot_core.control.build import build_core
from ibrobot_core.control.link import PlanRecord
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.units import NS_PER_S

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
BOUND_RAD = 0.04
"""26 ticks: the driver believes what a joint's speed explains to within 16 ticks, and a joint that speeds up."""


def document(port: str, calibration: Path) -> dict[str, Any]:
    return {
        "robot": {
            "name": "soak",
            "joints": [
                {"name": name, "lower": -1.5, "upper": 1.5, "max_velocity": 3.0, "max_acceleration": 40.0}
                for name in JOINTS
            ],
            "groups": {"all": list(JOINTS)},
        },
        "hardware": {"type": "feetech_so101", "port": port, "calibration": str(calibration), "anchored": []},
        "executors": {"position": {"type": "position", "group": "all"}},
        "control_modes": {"follow": {"executors": ["position"]}},
        "default_control_mode": "follow",
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--corrupt", type=float, default=0.01, help="probability of each byte")
    parser.add_argument("--drop", type=float, default=0.01, help="probability of each reply")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    clock = SteppedClock(1_700_000_000 * NS_PER_S)
    calibration = Calibration({name: JointCalibration(i, 0, 0, 1000, 3100) for i, name in enumerate(JOINTS, 1)})
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, Emulator(6, clock=clock, seed=arguments.seed) as emulator:
        for servo in emulator.servos.values():
            servo.set("min_position_limit", 1000)
            servo.set("max_position_limit", 3100)
        file = save_calibration(calibration, Path(folder) / "arm.json")
        config = from_document(document(emulator.port, file), source=Path("soak.yaml"), sim=False)
        core = build_core(config, installed_plugins(), clock, 0)
        core.start("follow")
        emulator.faults.corrupt, emulator.faults.drop = arguments.corrupt, arguments.drop
        ticks = round(arguments.seconds * 1e9 / core.period_ns)
        stale = wrong = outside = 0
        worst = 0.0
        faults: list[str] = []
        before = np.zeros(6)
        for tick in range(ticks):
            clock.advance(core.period_ns)
            path = 0.8 * math.sin(tick / 100) * np.array([1, -1, 1, -1, 1, 0.5])
            core.set_plan(PlanRecord(core.generation, clock.now_ns(), 1, np.ones(6, dtype=bool), path[np.newaxis]))
            state = core.tick()
            with emulator.lock:
                truth = np.array([(s.encoder - 2048) * 2 * math.pi / 4096 for s in emulator.servos.values()])
            if state.stale:
                stale += 1
            else:
                error = float(np.abs(state.position - truth).max())
                worst = max(worst, error)
                wrong += error > BOUND_RAD
            if tick:
                outside += bool((np.abs(state.command - before) > 3.0 * core.period_ns * 1e-9 + 1e-9).any())
            before = state.command
            while core.events:
                event = core.events.popleft()
                if event["event"] == "fault":
                    faults.append(str(event["fault"]))
            if core.fault and tick % 100 == 99:
                core.handle({"do": "reset", "id": 0})
        counters = core.counters()
        done = dict(emulator.faults.counts)
        core.close()
    bus = counters["hardware"]["hardware"]
    result = {
        "ticks": ticks,
        "took_s": round(time.monotonic() - begun, 1),
        "stale_ticks": stale,
        "faults": faults,
        "wrong_positions": wrong,
        "worst_error_rad": round(worst, 4),
        "commands_too_fast": outside,
        "emulator": done,
        "bus": bus,
        "safety": counters["safety"],
    }
    print(json.dumps(result, indent=2))
    counted = bus["timeouts"] + bus["bad_packets"] + bus["discarded_bytes"]
    return 1 if wrong or outside or counted < done["dropped"] else 0


if __name__ == "__main__":
    sys.exit(main())
