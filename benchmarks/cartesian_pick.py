"""Success of the scripted pick whose actions are poses of the tool, beside the same expert with joints, seed by seed.

    python benchmarks/cartesian_pick.py [--episodes 100] [--seed 0]

Runs `configs/so101_blind.yaml` as `ibrobot launch --lockstep` does, twice: with the joints' positions as actions, and
with `tool.position`, `tool.rotation_6d` and the gripper, which inverse kinematics turns into positions. Prints one JSON
object, and exits with 1 when fewer than 95 % of the Cartesian episodes succeed.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import figures

from ibrobot_core.config import load_config
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

CONFIG = Path(__file__).parents[1] / "configs" / "so101_blind.yaml"
CARTESIAN = ("contract.actions.0.select=[tool.position, tool.rotation_6d]", "models.scripted_pick.actions=tool")


def run(seed: int, episodes: int, overrides: tuple[str, ...]) -> dict[str, Any]:
    """Run episodes with these seeds; returns the summary of the run."""
    config = load_config(CONFIG, sim=True, overrides=overrides)
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, seed=seed, episodes=episodes)))
    runtime.start()
    while not runtime.step():
        pass
    runtime.stop()
    runtime.raise_failure()
    return dict(runtime.summary())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; later ones count up")
    arguments = parser.parse_args()
    won: dict[str, list[bool]] = {}
    report: dict[str, Any] = {"episodes": arguments.episodes}
    for name, overrides in (("joints", ()), ("tool", CARTESIAN)):
        begin, outcomes, unreachable = perf_counter(), [], 0
        interventions: dict[str, int] = {}
        for seed in range(arguments.seed, arguments.seed + arguments.episodes):
            summary = run(seed, 1, overrides)
            outcomes.append(summary["successes"] == 1)
            unreachable += summary["unreachable"]
            for kind, count in summary["counters"]["safety"].items():
                interventions[kind] = interventions.get(kind, 0) + count
        won[name] = outcomes
        report[name] = {
            "successes": sum(outcomes),
            "unreachable": unreachable,
            "interventions": {kind: count for kind, count in interventions.items() if count},
            "wall_s": round(perf_counter() - begin, 1),
        }
    pairs = list(zip(won["joints"], won["tool"], strict=True))
    report["only_joints"] = pairs.count((True, False))
    report["only_tool"] = pairs.count((False, True))
    print(json.dumps(report))
    figures.report(
        joints=report["joints"]["successes"],
        tool=report["tool"]["successes"],
        unreachable=report["tool"]["unreachable"],
        only_joints=report["only_joints"],
        only_tool=report["only_tool"],
    )
    return 0 if report["tool"]["successes"] >= 0.95 * arguments.episodes else 1


if __name__ == "__main__":
    sys.exit(main())
