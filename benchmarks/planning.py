"""Plans around obstacles: success, times, clearance and limits, on five kinds of scenes with the SO-101.

    python benchmarks/planning.py [--problems N] [--kinds table_pick,cage]

Every problem was solved before by a search of a minute; those in `UNSOLVED` were not, and are left out. MuJoCo measures
the clearance of every timed trajectory at each millisecond, with shapes of its own making. Exits with 1 where a problem
is not solved, a motion comes too near or exceeds a limit, or fewer than 95 % of a kind are solved in `FIRST_S`.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Iterable, Iterator
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
"""Kind -> processor time in which nearly all are to be solved [s]; 1 s for the others."""
SEARCH_S, CLEARANCE_M = 60.0, 0.0049


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
    """Least one of the motions [m]."""
    beyond: int = 0
    """Number of motions beyond the limits."""

    def run(self, name: Any, planner: RrtConnectPlanner, request: PlanRequest) -> Motion | None:
        """Plan, and note the times; None where there is no plan."""
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            motion = motion_of(planner.plan(request).trajectory)
        except PlanningError as error:
            self.failed.append((name, f"{error.code.name}: {error}"[:120]))
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
        return (
            f"solved {len(self.walls)}/{number}, {wall} (CPU time: {cpu}) within {limit_s:g} s; {times}; motion"
            f" {np.median(list(self.durations.values())):.2f} s; clearance {1000 * self.clearance:.2f} mm, beyond the"
            f" limits {self.beyond}" + (f"; failed {self.failed[:3]}" if self.failed else "")
        )


def measure(kind: str, tasks: list[Problem]) -> Plans:
    """Plan all problems of a kind."""
    context = Context("benchmark", SteppedClock(0), logging.getLogger("benchmark"), so101())
    planner = RrtConnectPlanner(RrtConnectOptions(padding=PADDING_M, planning_time=SEARCH_S), context)
    planner.load()
    plans, jerk = Plans(), 0.0
    for task in tasks:
        planner.world = task.world
        request = PlanRequest(ARM_JOINTS, task.start, JointGoal(ARM_JOINTS, task.goal))
        motion = plans.run(task.seed, planner, request)
        if motion is not None:
            positions = plans.check(so101(), range(5), motion)
            plans.clearance = min(plans.clearance, Referee(MJCF, ARM_JOINTS, task.world).clearance(positions))
            jerk = max(jerk, motion.jerk)
    print(f"{kind:12s} {plans.text(len(tasks), FIRST_S.get(kind, 1.0))}; jerk {jerk:.0f} rad/s^3", flush=True)
    return plans


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--kinds", default=",".join(KINDS))
    arguments = parser.parse_args()
    maker, number, good = Maker(), arguments.problems, True
    found: dict[str, Plans] = {}
    for kind in arguments.kinds.split(","):
        found[kind] = plans = measure(kind, list(problems(maker, kind, number)))
        good &= not plans.failed and not plans.beyond and plans.clearance > CLEARANCE_M
        good &= plans.within(FIRST_S.get(kind, 1.0))[0] >= 0.95 * number
    report(
        solved=sum(len(plans.cpus) for plans in found.values()),
        least_clearance_mm=1000 * min(plans.clearance for plans in found.values()),
        **{f"{kind}_median_ms": 1000 * float(np.median([*plans.cpus.values()])) for kind, plans in found.items()},
    )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
