"""Cost of one smoother update: a 100x6 chunk that overlaps the plan by 99, against the bare numpy recurrence.

Both are timed in turn in the same run, so that a busy machine slows both. Exits with 1 when an update costs more than
twice the recurrence.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ibrobot_core.dispatch.smoother import TemporalSmoother

LENGTH, SIZE, STEP_NS, COEFF = 100, 6, 33_333_333, 0.01


class Recurrence:
    """`(old * cumsum[c - 1] + new * w[c]) / cumsum[c]` and the new tail, with nothing around it."""

    def __init__(self) -> None:
        self.weights = np.exp(-COEFF * np.arange(LENGTH))[:, None]
        self.cumsum = np.cumsum(self.weights)[:, None]
        self.plan = np.zeros((LENGTH - 1, SIZE))
        self.counts = np.arange(LENGTH - 1, 0, -1)

    def update(self, new: np.ndarray) -> np.ndarray:
        """One update; the plan stays, so that every call costs the same."""
        c = self.counts
        blended = (self.plan * self.cumsum[c - 1] + new[:-1] * self.weights[c]) / self.cumsum[c]
        return np.concatenate((blended, new[-1:]))


def elapsed_us(call: Callable[..., Any], *args: Any) -> float:
    begin = time.perf_counter_ns()
    call(*args)
    return (time.perf_counter_ns() - begin) / 1e3


def measure(updates: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    chunks = rng.uniform(-1, 1, (64, LENGTH, SIZE))
    smoother, recurrence = TemporalSmoother(STEP_NS, SIZE, coeff=COEFF), Recurrence()
    times = np.empty((updates, 2))
    warm_up = 2 * LENGTH
    gc.disable()
    for k in range(-warm_up, updates):
        chunk, now = chunks[k % 64], k * STEP_NS
        smoother.trim(now)
        pair = (elapsed_us(smoother.update, chunk, now), elapsed_us(recurrence.update, chunk))
        if k >= 0:
            times[k] = pair
    gc.enable()
    median, p99 = np.percentile(times, (50, 99), axis=0)
    return {
        "updates": updates,
        "smoother_us": {"p50": round(median[0], 1), "p99": round(p99[0], 1)},
        "recurrence_us": {"p50": round(median[1], 1), "p99": round(p99[1], 1)},
        "ratio": {"p50": round(median[0] / median[1], 2), "p99": round(p99[0] / p99[1], 2)},
        "limit": 2.0,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=20_000, help="pairs to time")
    result = measure(parser.parse_args().updates)
    print(json.dumps(result))
    return 0 if result["ratio"]["p50"] <= result["limit"] else 1


if __name__ == "__main__":
    sys.exit(main())
