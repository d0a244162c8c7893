"""Success rate and CPU time per episode of the scripted expert of each scene, in lockstep, without cameras.

    python benchmarks/scenes.py [--episodes 100] [--seed 0] [--scene NAME …]

Runs what `ibrobot launch so101_scenes --sim --lockstep --set simulation.scene=NAME --mode NAME` runs; the first ten
seeds twice more, since equal seeds have to give equal bytes. Prints a table and a line of JSON a scene, and exits with
1 when an expert succeeds in fewer than 95 % of the episodes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path
from time import process_time
from typing import Any

import figures

from ibrobot_core.config import load_config
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

CONFIGS = Path(__file__).parents[1] / "configs"
SCENES = ("pick_cube", "push", "stack", "sort", "drawer", "handover")
REPEATED = 10
"""Episodes that are run twice."""


def run(scene: str, episodes: int, seed: int, overrides: list[str]) -> dict[str, Any]:
    """Successes, duration and a digest of all states of the episodes from `seed` on."""
    overrides = [f"simulation.scene={scene}", *overrides]
    name = "bi_so101_handover" if scene == "handover" else "so101_scenes"
    config = load_config(CONFIGS / f"{name}.yaml", sim=True, mode=scene, overrides=overrides)
    session = Session(config, installed_plugins(), LaunchRequest(lockstep=True, seed=seed, episodes=episodes))
    runtime = Runtime(session)
    digest, failed, number, before = hashlib.sha256(), [], 0, 0
    begin = process_time()
    runtime.start()
    while not runtime.step():
        state = session.state
        assert state is not None
        for values in (state.position, state.velocity, state.command, state.signals):
            digest.update(values.tobytes())
        if session.outcome.episodes > number:
            if session.outcome.successes == before:
                failed.append(seed + number)
            number, before = session.outcome.episodes, session.outcome.successes
    if session.outcome.episodes > number and session.outcome.successes == before:
        failed.append(seed + number)
    runtime.stop()
    runtime.raise_failure()
    cpu_s, summary = process_time() - begin, runtime.summary()
    return {
        "scene": scene,
        "episodes": summary["episodes"],
        "successes": summary["successes"],
        "failed_seeds": failed,
        "simulated_s": round(summary["duration_s"] / episodes, 2),
        "cpu_s": round(cpu_s / episodes, 3),
        "interventions": {name: count for name, count in summary["counters"]["safety"].items() if count},
        "digest": digest.hexdigest()[:16],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; later ones count up")
    parser.add_argument("--scene", action="append", choices=SCENES, help="only these")
    parser.add_argument("--set", action="append", default=[], dest="overrides", help="as of ibrobot launch")
    arguments = parser.parse_args()
    good = True
    print("| scene | successes | simulated s per episode | CPU s per episode | equal seeds, equal bytes |")
    print("|---|---|---|---|---|")
    reports = []
    for scene in arguments.scene or SCENES:
        report = run(scene, arguments.episodes, arguments.seed, arguments.overrides)
        few = min(REPEATED, arguments.episodes)
        digests = {run(scene, few, arguments.seed, arguments.overrides)["digest"] for _ in range(2)}
        report["equal"] = len(digests) == 1
        enough = report["successes"] >= 0.95 * arguments.episodes
        good &= enough and report["equal"]
        rate = f"{report['successes']} of {report['episodes']}"
        equal = "yes" if report["equal"] else "NO"
        print(f"| {scene} | {rate} | {report['simulated_s']} | {report['cpu_s']} | {equal} |", flush=True)
        reports.append(report)
    for report in reports:
        print(json.dumps(report))
    figures.report(**{report["scene"]: report["successes"] for report in reports})
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
