"""Whether the guard leaves motion alone that harms nothing: episodes with it and without it, on the same seeds.

    python benchmarks/guard_experts.py [--episodes 20] [--seed 200] [--policy CHECKPOINT]

The scripted experts pick a cube (also with the objects of the scene in the section `world`), push, stack, sort, open a
drawer and hand a bar over, each with the guard of the robot YAML and with `control.guard=null`. `--policy` adds a
policy that LeRobot has trained on the pick, e.g. of the tutorial "Train a policy". Exits with 1 if they succeed less
often with the guard, or take more than 1 % longer.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

import attrs
from figures import report

RUNS = {
    "pick_cube": ("so101_scenes", "simulation.scene=pick_cube"),
    "push": ("so101_scenes", "simulation.scene=push"),
    "stack": ("so101_scenes", "simulation.scene=stack"),
    "sort": ("so101_scenes", "simulation.scene=sort"),
    "drawer": ("so101_scenes", "simulation.scene=drawer"),
    "handover": ("bi_so101_handover",),
    "scripted": ("so101_pick_cube",),
}
"""Mode -> robot YAML and settings."""
MOST_SLOWER = 0.01


@attrs.frozen
class Came:
    """What became of the episodes of a run."""

    successes: tuple[bool, ...]
    ticks: int
    """Of the whole run."""


def run(mode: str, settings: tuple[str, ...], episodes: int, seed: int, policy: Path | None) -> Came:
    """Run episodes in lockstep."""
    robot, *changes = settings
    program = Path(sys.executable).with_name("ibrobot")
    command = [str(program), "launch", robot, "--sim", "--lockstep", "--headless"]
    command += ["--mode", mode, "--seed", str(seed), "--episodes", str(episodes)]
    command += [part for change in changes for part in ("--set", change)]
    environment = os.environ | ({} if policy is None else {"IBROBOT_POLICY": str(policy)})
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    successes = re.findall(r"^I episode \d+: (success|failure)$", done.stderr + done.stdout, re.MULTILINE)
    ticks = re.search(r"(\d+) ticks in lockstep", done.stdout)
    if ticks is None or len(successes) != episodes:
        raise SystemExit(f"{' '.join(command)} has failed:\n{done.stdout}{done.stderr}")
    return Came(tuple(word == "success" for word in successes), int(ticks[1]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20, help="of each expert")
    parser.add_argument("--seed", type=int, default=200)
    parser.add_argument("--policy", type=Path, help="a checkpoint of LeRobot's")
    parser.add_argument("--modes", nargs="+", default=list(RUNS), choices=list(RUNS))
    asked = parser.parse_args()
    runs = {mode: RUNS[mode] for mode in asked.modes}
    if asked.policy is not None:
        runs["learned"] = ("so101_pick_cube",)
    totals = {"with": 0, "without": 0, "ticks_with": 0, "ticks_without": 0, "lost": 0, "won": 0}
    for mode, settings in runs.items():
        guarded = run(mode, settings, asked.episodes, asked.seed, asked.policy)
        free = run(mode, (*settings, "control.guard=null"), asked.episodes, asked.seed, asked.policy)
        pairs = list(zip(guarded.successes, free.successes, strict=True))
        lost, won = pairs.count((False, True)), pairs.count((True, False))
        totals["with"] += sum(guarded.successes)
        totals["without"] += sum(free.successes)
        totals["lost"] += lost
        totals["won"] += won
        totals["ticks_with"] += guarded.ticks
        totals["ticks_without"] += free.ticks
        print(
            f"{mode:10} of {asked.episodes}: with the guard {sum(guarded.successes)}, without {sum(free.successes)};"
            f" only without {lost}, only with {won}; {guarded.ticks} and {free.ticks} ticks",
            flush=True,
        )
    slower = totals["ticks_with"] / totals["ticks_without"] - 1
    report(
        episodes=asked.episodes * len(runs), successes=totals["with"], successes_without=totals["without"],
        lost=totals["lost"], won=totals["won"], slower_percent=100 * slower,
    )  # fmt: skip
    return int(totals["with"] < totals["without"] or slower > MOST_SLOWER)


if __name__ == "__main__":
    sys.exit(main())
