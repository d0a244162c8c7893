"""Success rate and speed of the scripted pick in lockstep simulation, without cameras.

    python benchmarks/scripted_pick.py [--seeds 100] [--start-pose rest]

Each seed is one episode through the real hardware class, safety layer, position executor and temporal smoother at
100 Hz. Prints one JSON object; `infer_ms` is the episode's first call, which plans, and all later ones. Exits with 1
when fewer than 95 % succeed, or when it was slower than real time.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path
from time import perf_counter

import numpy as np
from ibrobot_mujoco.options import MujocoOptions

from ibrobot_core.errors import PolicyError

# It lies beside the tests, which use it too.
sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "ibrobot-plugin-mujoco" / "tests"))
from pick_loop import Outcome, PickLoop

SUCCESS_RATE, DURATION_S = 0.95, 8.0


def summary(values: list[float]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 2), "max": round(max(values), 2)} if values else {}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100, help="episodes, with seeds from 0 on")
    parser.add_argument("--start-pose", default="rest", help="named pose in which episodes begin")
    arguments = parser.parse_args()
    loop = PickLoop(MujocoOptions(start_pose=arguments.start_pose))
    outcomes: list[Outcome] = []
    failures: dict[int, str] = {}
    begin = perf_counter()
    for seed in range(arguments.seeds):
        try:
            outcome = loop.run(seed, DURATION_S)
        except PolicyError as error:
            failures[seed] = str(error)
            continue
        outcomes.append(outcome)
        if not outcome.success:
            failures[seed] = "the cube is not in the bin"
    wall_s = perf_counter() - begin
    realtime_factor = len(outcomes) * DURATION_S / wall_s
    first = [1e3 * outcome.infer_s[0] for outcome in outcomes]
    later = [1e3 * taken for outcome in outcomes for taken in outcome.infer_s[1:]]
    done_s = [outcome.success_s for outcome in outcomes if outcome.success_s is not None]
    report = {
        "episodes": arguments.seeds,
        "successes": arguments.seeds - len(failures),
        "failures": failures,
        "success_after_s": summary(done_s),
        "episode_wall_s": round(wall_s / arguments.seeds, 3),
        "realtime_factor": round(realtime_factor, 1),
        "infer_ms": {"first": summary(first), "later": summary(later)},
        "interventions": dict(sum((Counter(outcome.interventions) for outcome in outcomes), Counter())),
        "contacts_with_scenery": sorted(set().union(*(outcome.bumps for outcome in outcomes))),
    }
    print(json.dumps(report))
    return 0 if report["successes"] >= SUCCESS_RATE * arguments.seeds and realtime_factor > 1 else 1


if __name__ == "__main__":
    sys.exit(main())
