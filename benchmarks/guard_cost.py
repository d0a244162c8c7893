"""What the guard costs: the time of a check by the number of bodies, of a change, and the lateness of the loop.

    python benchmarks/guard_cost.py [--ticks 2000] [--pairs 6] [--seconds 10] [--parts checks changes lateness]

`checks`: an SO-101 moves among 5 to 500 boxes, and in a point cloud of 20,000 cells around it, aimed at contacts;
median and 99th percentile of the processor time of a tick in the safety layer. `changes`: processor time from a change
of a world of 20 boxes until the loop can have it, for one SO-101 and for two. `lateness`: in real time, runs of the
simulated SO-101 with 20 objects around it, with the guard and without, by turns; how late ticks begin, and the load of
the machine. Exits with 1 if the median ratio of the p99 of the lateness is above 1.3, or the median change takes longer
than two ticks.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from apparatus import CONFIGS, ended, report, running
from guard_trials import Commanders, Judge, Loop, Station, stations
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.world.objects import Box, Voxels, WorldObject

from ibrobot_core.api import Pose, Vector3
from ibrobot_core.app import load_config

BODIES = (5, 20, 100, 500)
CELLS, CELL_M = 20_000, 0.01
ALLOWED_RATIO = 1.3
TWO_TICKS_MS = 20.0
PARTS = ("checks", "changes", "lateness")


def places(count: int, rng: np.random.Generator) -> dict[str, tuple[float, float, float]]:
    """Places of boxes around an arm, the nearest within its reach [m]."""
    of_boxes = {}
    for number in range(count):
        angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.28, 0.45 if count < 50 else 1.5)
        of_boxes[f"box{number}"] = (away * np.cos(angle), away * np.sin(angle), rng.uniform(0.03, 0.4))
    return of_boxes


def boxes(count: int, rng: np.random.Generator) -> dict[str, WorldObject]:
    """Boxes around an arm."""
    return {
        name: WorldObject(Box((0.05, 0.05, 0.05)), Pose(Vector3(*place))) for name, place in places(count, rng).items()
    }


def cloud(rng: np.random.Generator, cells: int = CELLS) -> WorldObject:
    """A shell of occupied cells around an arm, as thick as it takes, 0.25 m away."""
    grid = np.array(list(itertools.product(range(-50, 50), range(-50, 50), range(1, 45))))
    away = np.linalg.norm(grid * CELL_M, axis=1)
    nearest = grid[(away > 0.25) & (rng.random(len(grid)) < 0.9)]
    order = np.argsort(np.linalg.norm(nearest * CELL_M, axis=1), kind="stable")
    return WorldObject(Voxels(CELL_M, nearest[order[:cells]]))


def check_times(
    station: Station, judge: Judge, world: Mapping[str, WorldObject], ticks: int
) -> tuple[list[float], int]:
    """Processor time of each tick of the safety layer with the guard [ms], and how many of them it changed."""
    rng = np.random.default_rng(0)
    judge.put({})
    loop = Loop(station, np.zeros(len(station.robot.joints)))
    loop.world(WorldChange(dict(world)))
    commanders = Commanders(station, judge, rng)
    took_ms, overruled = [], 0
    for tick in range(ticks):
        if tick % 50 == 0:
            stream = commanders.stream(str(rng.choice(commanders.KINDS)), loop.position)
        wanted = next(stream)
        begun_s = time.thread_time()
        loop.tick(wanted)
        took_ms.append(1e3 * (time.thread_time() - begun_s))
        overruled += bool(loop.overruled)
    return took_ms, overruled


def checks(ticks: int) -> dict[str, float]:
    """The table of the documentation, printed."""
    rng, figures = np.random.default_rng(1), dict[str, float]()
    with tempfile.TemporaryDirectory() as folder:
        station = stations(Path(folder))["so101"]
        judge = Judge(station)
        worlds = {f"{count} boxes": boxes(count, rng) for count in BODIES} | {
            f"a cloud of {CELLS:,} cells": {"cloud": cloud(rng)}
        }
        print("| world | median [ms] | p99 [ms] | longest [ms] | ticks that it changed |\n|---|---|---|---|---|")
        for name, world in worlds.items():
            took_ms, overruled = check_times(station, judge, world, ticks)
            median, p99 = np.percentile(took_ms, (50, 99))
            share = overruled / ticks
            print(f"| {name} | {median:.2f} | {p99:.1f} | {max(took_ms):.1f} | {share:.0%} |", flush=True)
            key = "cloud" if "cloud" in name else name.replace(" ", "_")
            figures |= {f"{key}_median_ms": float(median), f"{key}_p99_ms": float(p99)}
    return figures


def changes(count: int = 30) -> dict[str, float]:
    """Processor time until the loop can have a change [ms], printed; the slowest median of each robot."""
    figures = dict[str, float]()
    with tempfile.TemporaryDirectory() as folder:
        arms = stations(Path(folder))
        for robot, hand in (("so101", "gripper"), ("bi_so101", "left_gripper")):
            loop = Loop(arms[robot], np.zeros(len(arms[robot].robot.joints)))
            loop.world(WorldChange(boxes(20, np.random.default_rng(1))))
            standing = WorldObject(Box((0.05, 0.05, 0.05)), Pose(Vector3(0.3, 0.3, 0.2)))
            carried = WorldObject(Box((0.02, 0.02, 0.02)), Pose(Vector3(0.0, 0.0, 0.05)), hand, frozenset({hand}))
            moved = {"it": Pose(Vector3(0.3, 0.3, 0.3))}
            kinds = {
                "add": WorldChange({"it": standing}), "move": WorldChange({}, moved=moved),
                "attach": WorldChange({"it": carried}), "detach": WorldChange({"it": standing}),
                "remove": WorldChange({}, ("it",)),
            }  # fmt: skip
            took_ms: dict[str, list[float]] = {kind: [] for kind in kinds}
            for _ in range(count):
                for kind, change in kinds.items():
                    begun_s = time.thread_time()
                    loop.world(change)
                    took_ms[kind].append(1e3 * (time.thread_time() - begun_s))
                    loop.tick(loop.position)
            medians = {kind: statistics.median(times) for kind, times in took_ms.items()}
            print(f"{robot}:", ", ".join(f"{kind} {median:.1f} ms" for kind, median in medians.items()), flush=True)
            figures[f"{robot}_slowest_change_ms"] = max(medians.values())
    return figures


def run(seconds: float, *, guarded: bool) -> dict[str, int]:
    """A run in real time with 20 objects; what its control loop counted."""
    rng = np.random.default_rng(2)
    objects = ", ".join(
        f"{name}: {{shape: box, size: [0.05, 0.05, 0.05], position: [{x:.3f}, {y:.3f}, {z:.3f}]}}"
        for name, (x, y, z) in places(20, rng).items()
    )
    overrides = [f"world.objects={{{objects}}}"] + ["control.guard=null"] * (not guarded)
    config = load_config(CONFIGS / "so101_pick_cube.yaml", sim=True, overrides=overrides)
    with running(config, duration_s=seconds + 1.0) as runtime:
        time.sleep(1.0)
        missed = runtime.session.control.report["loop"]["missed"]
        loop = ended(runtime)["loop"]
    return {"p50": loop["lateness_p50_us"], "p99": loop["lateness_p99_us"], "missed": loop["missed"] - missed}


def lateness(pairs: int, seconds: float) -> dict[str, float]:
    """Pairs of runs with and without the guard; in every other pair, the one without comes first."""
    of_pairs = []
    for number in range(pairs):
        load = os.getloadavg()[0]
        both = {guarded: run(seconds, guarded=guarded) for guarded in ((True, False) if number % 2 else (False, True))}
        of_pairs.append(both)
        print(
            f"pair {number + 1}, load {load:.2f}: lateness p50 {both[True]['p50']} us with the guard,"
            f" {both[False]['p50']} without, p99 {both[True]['p99']} and {both[False]['p99']} us;"
            f" missed {both[True]['missed']} and {both[False]['missed']}",
            flush=True,
        )
    ratios = [both[True]["p99"] / max(1, both[False]["p99"]) for both in of_pairs]
    print(f"p99 with the guard is {statistics.median(ratios):.2f} times that without, in the median of {pairs} pairs")
    return {
        "lateness_p99_ratio": statistics.median(ratios),
        "missed_guarded": sum(both[True]["missed"] for both in of_pairs),
        "missed_free": sum(both[False]["missed"] for both in of_pairs),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=2000, help="of each world")
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run")
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS)
    asked = parser.parse_args()
    logging.disable()
    figures: dict[str, float] = {}
    if "checks" in asked.parts:
        figures |= checks(asked.ticks)
    if "changes" in asked.parts:
        figures |= changes()
    if "lateness" in asked.parts:
        figures |= lateness(asked.pairs, asked.seconds)
    report(**figures)
    is_slow = any(value > TWO_TICKS_MS for name, value in figures.items() if name.endswith("slowest_change_ms"))
    is_late = figures.get("lateness_p99_ratio", 0.0) > ALLOWED_RATIO
    return int(is_slow or is_late)


if __name__ == "__main__":
    sys.exit(main())
