"""Whether the guard keeps arms out of themselves and the world, whoever commands, by MuJoCo's collision detection.

    python tests/shared/guarded_commands.py [--commands 30000] [--trials 200] [--outs 200] [--arms so101 …]
        [--kinds commanded …]

An SO-101, two of them, and a UR5 and an FR3 made from their URDFs, on a table. Five kinds of commands take turns (a
policy, a leader, limits, twists, trajectories), most of them aimed at configurations in contact, while posts, bars,
walls and cubes come, move and go. `commanded`: the safety layer with the guard; a tenth of these commands also go to an
arm without it. `without`: a tenth as many, of commanders that begin where such an arm is. `simulated`: the whole of
control with the simulated arm, a twentieth as many; also the way that the joints take. `appears`: an object appears on
the way of a moving arm. `backs_out`: near objects or in contact, an operator drives joints out. Exits with 1 if a
command leads into contact, a pair comes a millimetre nearer than its margin, a simulated arm touches, an arm comes
nearer than by braking at once or says another distance than MuJoCo, or an operator does not come out.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import guard_trials
import numpy as np
from guard_trials import Judge, Result, Station

TICKS = 1000
"""Commands between two starts."""
TRIALS = ("appears", "backs_out")
KINDS = ("commanded", "without", *TRIALS, "simulated")


@cache
def _judged(folder: Path, arm: str) -> tuple[Station, Judge]:
    station = guard_trials.stations(folder)[arm]
    return station, Judge(station)


def trial(task: tuple[Path, str, str, int]) -> tuple[str, str, Any, float]:
    """One trial: its arm, its kind, what came of it, and its processor time [s]."""
    folder, arm, kind, seed = task
    station, judge = _judged(folder, arm)
    begin = time.process_time()
    came: Any
    if kind == "commanded":
        came = guard_trials.commanded(station, judge, seed, TICKS, guarded=True)
    elif kind == "without":
        came = guard_trials.commanded(station, judge, seed, TICKS, guarded=False)
    elif kind == "simulated":
        came = guard_trials.simulated(station, judge, seed, TICKS, guarded=True)
    else:
        check: Callable[[Station, Judge, int], str] = getattr(guard_trials, kind)
        came = check(station, judge, seed)
    return arm, kind, came, time.process_time() - begin


def seeds(kind: str, asked: argparse.Namespace) -> range:
    """Of each arm."""
    starts = asked.commands / TICKS
    counts = {"commanded": starts, "without": starts / 10, "simulated": starts / 20, "backs_out": asked.outs}
    return range(asked.seed, asked.seed + max(1, round(counts.get(kind, asked.trials) / len(asked.arms))))


def summed(came: list[tuple[str, str, Any, float]]) -> dict[str, Result]:
    """What was counted for each arm, and for all; printed."""
    sums: dict[str, Result] = {}
    for arm, kind, result, _ in came:
        parts = {kind: result} if isinstance(result, Result) else {}
        if isinstance(result, tuple):
            parts = {"simulated": result[0], "measured": result[1]}
        for what, part in parts.items():
            sums.setdefault(f"{arm} {what}", Result()).add(part)
            sums.setdefault(what, Result()).add(part)
    for name, each in sums.items():
        print(
            f"{name:20} {each.commands:7} commands, {each.overruled:6} overruled, {each.changes:4} world changes,"
            f" {each.touched:6} touch; least {1e3 * each.least:8.3f} mm, beyond the margin {1e3 * each.kept:8.3f} mm"
            f" ({each.worst})"
            + (f"; up to {1e3 * each.nearer:.3f} mm nearer than the path of the commands" if each.nearer else "")
            + (f"; {each.unexplained} touch unexplained" if each.unexplained else "")
            + (f"; the same commands without the guard: {each.free_touched} of {each.free} touch" if each.free else "")
        )
    for arm in dict.fromkeys(arm for arm, *_ in came):
        times = [took_s for of, _, _, took_s in came if of == arm]
        print(f"{arm:20} {1e3 * float(np.mean(times)):.1f} ms of processor time for one {came[0][1]}", flush=True)
    return sums


def came_to(pool: Any, todo: list[tuple[Path, str, str, int]], kind: str) -> list[tuple[str, str, Any, float]]:
    """Run trials; what has come of them so far is printed after each twenty."""
    came: list[tuple[str, str, Any, float]] = []
    begun_s = time.monotonic()
    for each in pool.imap(trial, todo):
        came.append(each)
        if len(came) % 20 == 0 and len(came) < len(todo):
            so_far = Result()
            for *_, result, _ in came:
                for part in (result,) if isinstance(result, Result) else result if isinstance(result, tuple) else ():
                    so_far.add(part)
            wrong = [result for *_, result, _ in came if isinstance(result, str) and result]
            print(
                f"{kind}: {len(came)} of {len(todo)} in {time.monotonic() - begun_s:.0f} s; {so_far.commands} commands,"
                f" {so_far.overruled} overruled, {so_far.changes} world changes, {so_far.touched} touch, least beyond"
                f" the margin {1e3 * so_far.kept:.3f} mm; without the guard {so_far.free_touched} of {so_far.free}"
                f" touch; {len(wrong)} failed",
                *wrong[-3:],
                flush=True,
            )
    return came


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", type=int, default=30_000, help="of all arms together")
    parser.add_argument("--trials", type=int, default=200, help="of `appears`")
    parser.add_argument("--outs", type=int, default=200, help="of `backs_out`")
    parser.add_argument("--arms", nargs="+", default=["so101", "bi_so101", "ur5", "fr3"])
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    logging.disable()
    sums: dict[str, Result] = {}
    problems = 0
    with tempfile.TemporaryDirectory() as name, multiprocessing.get_context("spawn").Pool(asked.processes) as pool:
        folder = Path(name)
        guard_trials.stations(folder)  # writes the UR5 and the FR3
        for kind in asked.kinds:
            todo = [(folder, arm, kind, seed) for seed in seeds(kind, asked) for arm in asked.arms]
            came = came_to(pool, todo, kind)
            sums |= summed(came)
            if kind in TRIALS:
                failed = [f"{arm}: {result}" for arm, _, result, _ in came if result]
                print(f"{kind:20} {len(came)} trials, {len(failed)} failed", *failed, sep="\n", flush=True)
                problems += len(failed)
    for what, least in (("commanded", -1e-3), ("simulated", -1e-3), ("measured", -np.inf)):
        problems += what in sums and (sums[what].touched > 0 or sums[what].kept < least)
    return int(problems > 0)


if __name__ == "__main__":
    sys.exit(main())
