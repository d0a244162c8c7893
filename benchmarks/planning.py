"""Plans around obstacles: success, times, clearance and limits, on five kinds of scenes with the SO-101.

    python benchmarks/planning.py [--problems N] [--kinds table_pick,cage] [--time S] [--no-check] [--roboplan]

With `--roboplan`, roboplan solves each problem, too, in turns, and the run fails where ours is slower, or its motions
take longer, on the problems that both solved.

Every problem was solved before by a search of a minute; those in `UNSOLVED` were not, and are left out. MuJoCo measures
the clearance of every timed trajectory at each millisecond, with shapes of its own making.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import count, islice
from typing import Any

import attrs
import numpy as np
from apparatus import report
from ibrobot_planning.planner import JointGoal, PlanRequest
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.planners.timing import Motion, motion_of
from planning_scenes import ARM_JOINTS, KINDS, MJCF, PADDING_M, Maker, Problem, so101
from referee import Referee

from ibrobot_core.api import Context, PlanningError, Robot, SteppedClock, Vector

UNSOLVED = {"cage": (6, 19, 40, 54, 58, 90, 92)}
"""Kind -> seeds of problems of which nobody knows whether they have a solution."""
FIRST_S = {"cage": 10.0}
CLEARANCE_M = 0.0049


WORST: dict[str, float] = {}
"""Of all kinds: the least clearance and the greatest ratios; the problems solved, together."""


def problems(maker: Maker, kind: str, number: int) -> Iterator[Problem]:
    """The first so many problems that have a solution."""
    solved = (seed for seed in count() if seed not in UNSOLVED.get(kind, ()))
    return (maker.problem(kind, seed) for seed in islice(solved, number))


@attrs.define
class Plans:
    """What a planner made of problems; dictionaries by the seeds of the solved ones, or what else names a problem."""

    walls: dict[Any, float] = attrs.field(factory=dict)
    """[s]."""
    cpus: dict[Any, float] = attrs.field(factory=dict)
    """[s]."""
    durations: dict[Any, float] = attrs.field(factory=dict)
    """Of the motions [s]."""
    failed: list[tuple[Any, str]] = attrs.field(factory=list)
    slack: float = 1.0
    """Times by which velocities and accelerations may be larger than their limits."""
    clearance: float = np.inf
    """Least one of the motions [m]; infinite where it was not measured."""
    beyond: int = 0
    """Number of motions beyond the limits."""

    def run(self, name: Any, plan: Callable[[], Motion | None]) -> Motion | None:
        """Plan, and note the times; None where there is no plan."""
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            motion = plan()
        except (PlanningError, RuntimeError) as error:
            code = f"{error.code.name}: " if isinstance(error, PlanningError) else ""
            self.failed.append((name, f"{code}{error}"[:120]))
            return None
        assert motion is not None
        self.walls[name] = time.perf_counter() - wall
        self.cpus[name] = time.process_time() - cpu
        self.durations[name] = motion.duration
        return motion

    def check(self, robot: Robot, columns: Iterable[int], motion: Motion) -> Vector:
        """Measure the limits; the positions of each millisecond, shape (N, J).

        Args:
            robot: the robot.
            columns: which of its joints move.
            motion: of these.
        """
        positions, velocities, accelerations = motion.sampled(0.001)
        order = list(columns)
        self.beyond += bool(
            (np.abs(velocities) > self.slack * robot.max_velocity[order]).any()
            or (np.abs(accelerations) > self.slack * robot.max_acceleration[order]).any()
            or (positions < robot.lower[order] - 1e-6).any()
            or (positions > robot.upper[order] + 1e-6).any()
        )
        return positions

    def within(self, limit_s: float) -> tuple[int, int]:
        """Problems solved in this time, by the processor's, since planning takes one thread, and by the clock."""
        cpu, wall = (sum(each <= limit_s for each in times.values()) for times in (self.cpus, self.walls))
        return cpu, wall

    def text(self, number: int, limit_s: float) -> str:
        """A line about all `number` problems, and how many were solved within `limit_s`."""
        if not self.walls:
            return f"solved 0/{number}; failed {self.failed[:3]}"
        cpu, wall = self.within(limit_s)
        all_ms = {"wall": 1000 * np.array([*self.walls.values()]), "CPU": 1000 * np.array([*self.cpus.values()])}
        times = ", ".join(
            f"{name} {np.median(each):.1f} ms (p95 {np.percentile(each, 95):.1f}, most {each.max():.1f})"
            for name, each in all_ms.items()
        )
        measured = f"; clearance {1000 * self.clearance:.2f} mm, beyond the limits {self.beyond}"
        return (
            f"solved {len(self.walls)}/{number}, {wall} (CPU time: {cpu}) within {limit_s:g} s; {times}; motion"
            f" {np.median(list(self.durations.values())):.2f} s"
            + (measured if np.isfinite(self.clearance) else "")
            + (f"; failed {self.failed[:3]}" if self.failed else "")
        )


def compared(ours: Plans, theirs: Plans) -> tuple[str, dict[str, float]]:
    """Both on the problems that both solved, and the ratios that may not be above 1."""
    both = sorted(ours.cpus.keys() & theirs.cpus.keys())
    ratios = []
    for mine, other in ((ours.cpus, theirs.cpus), (ours.durations, theirs.durations)):
        a, b = np.array([mine[seed] for seed in both]), np.array([other[seed] for seed in both])
        ratios.append([*(np.percentile(a, part) / np.percentile(b, part) for part in (50, 95)), np.median(a / b)])
    (cpu, cpu_tail, cpu_pairs), (motion, motion_tail, motion_pairs) = ratios
    text = (
        f"on the {len(both)} solved by both, ours to roboplan's: CPU median {cpu:.2f}, p95 {cpu_tail:.2f}, of the pairs"
        f" {cpu_pairs:.2f}; motion median {motion:.2f}, p95 {motion_tail:.2f}, of the pairs {motion_pairs:.2f}"
    )
    return text, {"cpu": cpu, "cpu_p95": cpu_tail, "motion": motion}


def measure(maker: Maker, kind: str, tasks: list[Problem], seconds: float, *, check: bool, beside: bool) -> bool:
    """Plan all problems; with `beside`, each by roboplan, too, in turns."""
    context = Context("benchmark", SteppedClock(0), logging.getLogger("benchmark"), so101())
    planner = RrtConnectPlanner(RrtConnectOptions(padding=PADDING_M, planning_time=seconds), context)
    planner.load()
    first_s, jerks = FIRST_S.get(kind, 1.0), dict[int, float]()
    ours, theirs = Plans(), Plans()

    def mine(task: Problem) -> None:
        planner.world = task.world
        request = PlanRequest(ARM_JOINTS, task.start, JointGoal(ARM_JOINTS, task.goal))
        motion = ours.run(task.seed, lambda: motion_of(planner.plan(request).trajectory))
        if check and motion is not None:
            positions = ours.check(so101(), range(5), motion)
            clearance = Referee(MJCF, ARM_JOINTS, task.world).clearance(positions)
            ours.clearance, jerks[task.seed] = min(ours.clearance, clearance), motion.jerk

    def other(task: Problem) -> None:
        import planning_roboplan

        scene = planning_roboplan.made(maker, task.world)
        theirs.run(task.seed, lambda: planning_roboplan.plan(scene, task, FIRST_S.get(kind, 5.0)))

    for number, task in enumerate(tasks):
        turns = (mine, other) if beside else (mine,)
        for turn in turns if number % 2 else reversed(turns):
            turn(task)
    jerk = f"; jerk {max(jerks.values()):.0f} rad/s^3" if jerks else ""
    print(f"{kind:12s} {ours.text(len(tasks), first_s)}{jerk}", flush=True)
    good = not ours.failed and not ours.beyond and ours.clearance > CLEARANCE_M
    WORST["solved"] = WORST.get("solved", 0) + len(ours.cpus)
    if check:
        WORST["least_clearance_mm"] = min(WORST.get("least_clearance_mm", np.inf), 1000 * ours.clearance)
    good &= ours.within(first_s)[0] >= 0.95 * len(tasks)
    if beside:
        text, ratios = compared(ours, theirs)
        good &= max(ratios.values()) <= 1
        for name, ratio in ratios.items():
            WORST[f"{name}_ratio"] = max(WORST.get(f"{name}_ratio", 0.0), ratio)
        print(f"{'':12s} roboplan {theirs.text(len(tasks), first_s)}\n{'':12s} {text}", flush=True)
    return good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--time", type=float, default=60.0, help="of a search [s]")
    parser.add_argument("--no-check", action="store_true", help="do not measure clearance")
    parser.add_argument(
        "--roboplan", action="store_true", help="the same problems by roboplan, which must be installed"
    )
    arguments = parser.parse_args()
    maker, kinds = Maker(), arguments.kinds.split(",")
    good = True
    for kind in kinds:
        tasks = list(problems(maker, kind, arguments.problems))
        good &= measure(maker, kind, tasks, arguments.time, check=not arguments.no_check, beside=arguments.roboplan)
    report(**WORST)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
