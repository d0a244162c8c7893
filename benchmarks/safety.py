"""Cost of one tick of the safety layer for six joints, against a bare np.clip of the same size.

    python benchmarks/safety.py

Both are timed in turn in the same run, so that a busy machine slows both. `smooth` is a plan within all limits, `wild`
is uniform noise far beyond them, of which nearly every joint is limited and counted. Exits with 1 when the median of a
smooth tick exceeds 60 us.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from typing import Any

import numpy as np
from apparatus import report

from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.robot import Joint, Robot

JOINTS, PERIOD_NS, BUDGET_US = 6, 10_000_000, 60.0
ROBOT = Robot(
    name="benchmark",
    joints=tuple(
        Joint(name=f"j{i}", lower=-1.9, upper=1.9, max_velocity=4.0, max_acceleration=20.0) for i in range(JOINTS)
    ),
)


def measure(stream: np.ndarray) -> dict[str, Any]:
    layer = SafetyLayer(ROBOT, PERIOD_NS)
    lower, upper, measured = ROBOT.lower, ROBOT.upper, np.zeros(JOINTS)
    layer.activate(measured)
    times = np.empty((len(stream), 2))
    gc.disable()
    for row, desired in zip(times, stream, strict=True):
        begin = time.perf_counter_ns()
        measured = layer.apply(desired, measured)
        middle = time.perf_counter_ns()
        np.clip(desired, lower, upper)
        row[:] = middle - begin, time.perf_counter_ns() - middle
    gc.enable()
    (layer_p50, clip_p50), (layer_p99, clip_p99) = np.percentile(times / 1e3, (50, 99), axis=0)
    return {
        "layer_us": {"p50": round(layer_p50, 1), "p99": round(layer_p99, 1)},
        "clip_us": {"p50": round(clip_p50, 1), "p99": round(clip_p99, 1)},
        "ratio": {"p50": round(layer_p50 / clip_p50, 1), "p99": round(layer_p99 / clip_p99, 1)},
        "interventions": sum(layer.interventions.values()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=20_000, help="ticks to time of each stream")
    ticks = parser.parse_args().ticks
    seconds = np.arange(ticks)[:, np.newaxis] * PERIOD_NS / 1e9
    smooth = np.repeat(0.7 * (1 - np.cos(2.0 * seconds)), JOINTS, axis=1)
    wild = np.random.default_rng(0).uniform(-4, 4, (ticks, JOINTS))
    measure(smooth[:1000])  # warm
    result = {"ticks": ticks, "smooth": measure(smooth), "wild": measure(wild), "budget_us": BUDGET_US}
    print(json.dumps(result))
    smooth_us, wild_us = result["smooth"]["layer_us"], result["wild"]["layer_us"]
    report(
        p50_us=smooth_us["p50"], p99_us=smooth_us["p99"], limited_p50_us=wild_us["p50"], limited_p99_us=wild_us["p99"]
    )
    return 0 if result["smooth"]["layer_us"]["p50"] <= BUDGET_US else 1


if __name__ == "__main__":
    sys.exit(main())
