"""What the guard costs: the time of a check by the number of bodies, the lateness of the loop, and floods of changes.

    python benchmarks/guard_cost.py [--ticks 2000] [--pairs 6] [--seconds 10]
        [--parts checks memory changes lateness floods]

`checks`: an SO-101 moves among 5 to 500 boxes, and in a point cloud of 20,000 cells around it, aimed at contacts;
median and 99th percentile of the processor time of a tick in the safety layer. `memory`: what a tick among 20 boxes
allocates and keeps, and its processor time with garbage collection and without. `changes`: processor time from a change
of a world of 20 boxes until the loop can have it, for one SO-101 and for two. `lateness`: in real time, runs of the
simulated SO-101 with 20 objects around it, with the guard and without, by turns; how late ticks begin, and the load of
the machine. `floods`: in such runs, 200 objects are added within 4 s, an object moves 200 times a second, meshes of
79,000 triangles are added, move and go, and clouds of 20,000 cells come at 5 Hz; the ticks that control missed. Exits
with 1 if the median ratio of the p99 of the lateness is above 1.3, the median change takes longer than two ticks, or a
flood has control miss more ticks than the same run without it.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import logging
import os
import resource
import statistics
import struct
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import guard_trials
import numpy as np
from figures import report
from guard_trials import CONFIGS, Judge, Loop, Station
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.world.objects import Box, Voxels, WorldObject

from ibrobot_core.api import Pose, Vector3
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

BODIES = (5, 20, 100, 500)
CELLS, CELL_M = 20_000, 0.01
ALLOWED_RATIO = 1.3
TWO_TICKS_MS = 20.0
PARTS = ("checks", "memory", "changes", "lateness", "floods")


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


def aimed(
    station: Station, judge: Judge, world: Mapping[str, WorldObject], ticks: int
) -> Iterator[tuple[Loop, Callable[[], object]]]:
    """Yield the safety layer with the guard, and a function that runs its next tick; commanders take turns."""
    rng = np.random.default_rng(0)
    judge.put({})
    loop = Loop(station, np.zeros(len(station.robot.joints)))
    loop.world(WorldChange(dict(world)))
    commanders = guard_trials.Commanders(station, judge, rng)
    for tick in range(ticks):
        if tick % 50 == 0:
            kind = str(rng.choice(commanders.KINDS))
            stream = commanders.stream(kind, loop.position)
        yield loop, partial(loop.tick, next(stream))


def check_times(
    station: Station, judge: Judge, world: Mapping[str, WorldObject], ticks: int
) -> tuple[list[float], int]:
    """Processor time of each tick of the safety layer with the guard [ms], and how many of them it changed."""
    took_ms, overruled = [], 0
    for loop, tick in aimed(station, judge, world, ticks):
        begun_s = time.thread_time()
        tick()
        took_ms.append(1e3 * (time.thread_time() - begun_s))
        overruled += bool(loop.overruled)
    return took_ms, overruled


def resident_kib() -> int:
    """Memory of this process that is in use [KiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def memory(ticks: int) -> dict[str, float]:
    """What a tick allocates and keeps, and whether garbage collection, which control switches off, costs time."""
    world = boxes(20, np.random.default_rng(1))
    with tempfile.TemporaryDirectory() as folder:
        station = guard_trials.stations(Path(folder))["so101"]
        judge, most = Judge(station), list[float]()
        tracemalloc.start()
        for _, tick in aimed(station, judge, world, 1 + ticks // 10):
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            tick()
            most.append((tracemalloc.get_traced_memory()[1] - before) / 1024)
        tracemalloc.stop()
        # The first tick takes over the world.
        figures = {"allocates_median_kib": statistics.median(most[1:]), "allocates_most_kib": max(most[1:])}
        figures["tick_collected_p99_ms"] = float(np.percentile(check_times(station, judge, world, ticks)[0], 99))
        gc.disable()
        figures["tick_uncollected_p99_ms"] = float(np.percentile(check_times(station, judge, world, ticks)[0], 99))
        for number, (_, tick) in enumerate(aimed(station, judge, world, ticks)):
            tick()
            if number == ticks // 2:
                half_kib = resident_kib()
        figures["uncollected_grows_kib"] = resident_kib() - half_kib
        gc.enable()
    for key, value in figures.items():
        print(f"{key}: {value:.3g}", flush=True)
    return figures


def checks(ticks: int) -> dict[str, float]:
    """The table of the documentation, printed."""
    rng, figures = np.random.default_rng(1), dict[str, float]()
    with tempfile.TemporaryDirectory() as folder:
        station = guard_trials.stations(Path(folder))["so101"]
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
        stations = guard_trials.stations(Path(folder))
        for robot, hand in (("so101", "gripper"), ("bi_so101", "left_gripper")):
            loop = Loop(stations[robot], np.zeros(len(stations[robot].robot.joints)))
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


def run(
    seconds: float, *, guarded: bool, flood: Callable[[Runtime, float], None] | None = None, more: Sequence[str] = ()
) -> dict[str, int]:
    """A run in real time with 20 objects, and more overrides; what its control loop counted after the first second."""
    rng = np.random.default_rng(2)
    objects = ", ".join(
        f"{name}: {{shape: box, size: [0.05, 0.05, 0.05], position: [{x:.3f}, {y:.3f}, {z:.3f}]}}"
        for name, (x, y, z) in places(20, rng).items()
    )
    overrides = [f"world.objects={{{objects}}}"] + ["control.guard=null"] * (not guarded) + [*more]
    config = load_config(CONFIGS / "so101_pick_cube.yaml", sim=True, overrides=overrides)
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(duration_s=seconds + 1.0)))
    runtime.start()
    try:
        time.sleep(1.0)
        missed = runtime.session.control.report["loop"]["missed"]
        flooding = threading.Thread(target=flood, args=(runtime, seconds)) if flood is not None else None
        if flooding is not None:
            flooding.start()
        while not runtime.wait(0.2):
            pass
        if flooding is not None:
            flooding.join()
        summary = runtime.summary()
        counted = runtime.session.control.report["counters"]["guard"]
    finally:
        runtime.stop()
    loop = summary["loop"]
    return {
        "p50": loop["lateness_p50_us"], "p99": loop["lateness_p99_us"], "missed": loop["missed"] - missed,
        "changes": counted.get("world_changes", 0), "pairs": counted.get("pairs", 0),
    }  # fmt: skip


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


def adds(runtime: Runtime, seconds: float) -> None:
    """200 objects within 4 s, and away again."""
    rng = np.random.default_rng(3)
    for number in range(179):  # there are 20, and the scene's
        x, y, z = rng.uniform(0.3, 1.0, 3)
        request = {
            "name": f"flood{number}",
            "object": {"shape": "box", "size": [0.02] * 3, "position": [float(x), float(y), float(z)]},
        }
        runtime.session.bus.call("/world/add", request)
        time.sleep(4.0 / 179)


def moves(runtime: Runtime, seconds: float) -> None:
    """An object moves 200 times a second."""
    for number in range(int(200 * (seconds - 1.0))):
        runtime.session.bus.call("/world/move", {"name": "box0", "position": [0.5, 0.3 + 0.2 * (number % 2), 0.2]})
        time.sleep(0.005)


def clouds(runtime: Runtime, seconds: float) -> None:
    """Clouds of 20,000 cells around the arm, another one each time."""
    for number in range(int(5 * (seconds - 1.0))):
        runtime.session.change_world(CLOUDS[number % len(CLOUDS)])
        time.sleep(0.2)


def meshes(runtime: Runtime, seconds: float) -> None:
    """Two meshes of 79,000 triangles, which come, move and go."""
    call, shape = runtime.session.bus.call, {"shape": "mesh", "file": "bowl.stl"}
    end_s = time.monotonic() + seconds - 3.0
    while time.monotonic() < end_s:
        for number in range(2):
            request = {"name": f"bowl{number}", "object": {**shape, "position": [0.3, 0.4 * number - 0.2, 0.1]}}
            call("/world/add", request)
        for number in range(20):
            call("/world/move", {"name": "bowl1", "position": [0.3, 0.2, 0.1 + 0.005 * number]})
            time.sleep(0.02)
        for number in range(2):
            call("/world/remove", {"name": f"bowl{number}"})


def bowl(path: Path, rings: int = 99) -> None:
    """Write a half sphere with a radius of 0.1 m, open at its top, as a binary STL of 8 * rings^2 triangles."""
    turn, tilt = np.meshgrid(np.linspace(0, 2 * np.pi, 4 * rings + 1), np.linspace(np.pi / 2, np.pi, rings + 1))
    at = 0.1 * np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]
    corners = np.stack([np.stack([a, b, c], axis=2), np.stack([b, d, c], axis=2)]).reshape(-1, 3, 3)
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = corners
    path.write_bytes(bytes(80) + struct.pack("<I", len(corners)) + rows.tobytes())


FLOODS = {
    "200 added objects": adds, "an object that moves at 200 Hz": moves, "meshes of 79,000 triangles": meshes,
    "clouds at 5 Hz": clouds,
}  # fmt: skip


CLOUDS: list[Mapping[str, Any]] = []
"""Made before the runs, which making them would delay."""


def floods(seconds: float) -> dict[str, float]:
    """Each flood, after the same run without one."""
    worse, rng = 0, np.random.default_rng(4)
    CLOUDS.extend(WorldChange({"cloud": cloud(rng)}).message() for _ in range(4))
    with tempfile.TemporaryDirectory() as folder:
        bowl(Path(folder) / "bowl.stl")
        for name, flood in FLOODS.items():
            calm = run(seconds, guarded=True)
            flooded = run(seconds, guarded=True, flood=flood, more=[f"world.meshes={folder}"])
            worse += max(0, flooded["missed"] - calm["missed"])
            print(
                f"{name}: {flooded['changes']} changes, {flooded['pairs']} pairs at the end; missed"
                f" {flooded['missed']}, {calm['missed']} without; lateness p99 {flooded['p99']} and {calm['p99']} us",
                flush=True,
            )
    return {"missed_more_in_floods": worse}


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
    if "memory" in asked.parts:
        figures |= memory(asked.ticks)
    if "changes" in asked.parts:
        figures |= changes()
    if "lateness" in asked.parts:
        figures |= lateness(asked.pairs, asked.seconds)
    if "floods" in asked.parts:
        figures |= floods(asked.seconds)
    report(**figures)
    is_slow = any(value > TWO_TICKS_MS for name, value in figures.items() if name.endswith("slowest_change_ms"))
    is_late = figures.get("lateness_p99_ratio", 0.0) > ALLOWED_RATIO
    return int(is_slow or is_late or figures.get("missed_more_in_floods", 0) > 0)


if __name__ == "__main__":
    sys.exit(main())
