"""Success rate and speed of the scripted pick in lockstep, without cameras, through the whole system.

    python benchmarks/scripted_pick.py [--episodes 100] [--seed 0]

Runs `configs/so101_blind.yaml` as `ibrobot launch --lockstep` does. Prints one JSON object, and exits with 1 when fewer
than 95 % of the episodes succeed or the run was slower than real time.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from time import perf_counter

from ibrobot_core.config import load_config
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import LaunchRequest, Session
from ibrobot_core.plugins import installed_plugins

CONFIG = Path(__file__).parents[1] / "configs" / "so101_blind.yaml"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; later ones count up")
    arguments = parser.parse_args()
    request = LaunchRequest(lockstep=True, seed=arguments.seed, episodes=arguments.episodes)
    runtime = Runtime(Session(load_config(CONFIG, sim=True), installed_plugins(), request))
    begin = perf_counter()
    runtime.start()
    while not runtime.step():
        pass
    runtime.stop()
    runtime.raise_failure()
    wall_s = perf_counter() - begin
    summary = runtime.summary()
    factor = summary["duration_s"] / wall_s
    report = {
        "episodes": summary["episodes"],
        "successes": summary["successes"],
        "simulated_s": summary["duration_s"],
        "wall_s": round(wall_s, 1),
        "realtime_factor": round(factor, 1),
        "interventions": {name: count for name, count in summary["counters"]["safety"].items() if count},
    }
    print(json.dumps(report))
    return 0 if summary["successes"] >= 0.95 * arguments.episodes and factor > 1 else 1


if __name__ == "__main__":
    sys.exit(main())
