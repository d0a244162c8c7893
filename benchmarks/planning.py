"""Plans around obstacles: success, times, clearance and limits, on five kinds of scenes with the SO-101.

    python benchmarks/planning.py [--problems N] [--kinds table_pick,cage] [--time S] [--roboplan]

With `--roboplan`, roboplan solves each problem, too, in turns, and the run fails where ours is slower, or its motions
take longer, on the problems that both solved.

Every problem was solved before by a long search (`--prove` searches for more). MuJoCo measures the clearance of every
timed trajectory at each millisecond, with shapes of its own making.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import attrs
import mujoco
import numpy as np
from figures import report
from ibrobot_kinematics.poses import matrix
from ibrobot_planning.planner import JointGoal, PlanRequest, PlanResult
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.planners.search import Pace, Space, connect, shortened
from ibrobot_planning.planners.timing import Motion
from ibrobot_planning.world.objects import Box, Cylinder, World
from planning_scenes import ARM_JOINTS, KINDS, MAX_ACCELERATION, MAX_VELOCITY, MJCF, PADDING_M, Maker, Problem, so101

from ibrobot_core.api import Context, PlanningError, SteppedClock, Vector

PROOFS = Path(__file__).with_name("planning_proofs.json")
"""Kind -> seed -> a path that solves the problem [mrad]."""
LONG_S = {"cage": 60.0}
FIRST_S = {"cage": 10.0}
CLEARANCE_M = 0.0049
PACE = Pace(np.full(5, MAX_VELOCITY), np.full(5, MAX_ACCELERATION), 0.5)


class Referee:
    """MuJoCo's model of the arm with a world, and distances in it."""

    def __init__(self, world: World) -> None:
        spec = mujoco.MjSpec.from_file(str(MJCF))
        for body in spec.bodies:
            geoms = list(body.geoms)
            if not any(geom.contype or geom.conaffinity for geom in geoms):
                for geom in geoms:
                    geom.contype = 1
        for geom in list(spec.geoms):
            if not (geom.contype or geom.conaffinity):
                spec.delete(geom)
        used = {geom.meshname for geom in spec.geoms}
        for mesh in list(spec.meshes):
            if mesh.name not in used:
                spec.delete(mesh)
        for name, thing in world.objects.items():
            placed = matrix(thing.pose)
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, placed[:3, :3].ravel())
            shape = thing.shape
            if isinstance(shape, Box):
                kind, size = mujoco.mjtGeom.mjGEOM_BOX, [each / 2 for each in shape.size]
            else:
                assert isinstance(shape, Cylinder)
                kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [shape.radius, shape.height / 2, 0]
            spec.worldbody.add_geom(name=f"world:{name}", type=kind, size=size, pos=placed[:3, 3], quat=quaternion)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        names = [self.model.geom(i).name for i in range(self.model.ngeom)]
        self._objects = [i for i, name in enumerate(names) if name.startswith("world:")]
        still = self.model.body("base").id
        self._links = [
            i
            for i in range(self.model.ngeom)
            if i not in self._objects
            and self.model.geom_bodyid[i] != still
            and (self.model.geom_contype[i] or self.model.geom_conaffinity[i])
        ]
        self._columns = [self.model.joint(name).qposadr[0] for name in ARM_JOINTS]

    def clearance(self, positions: Vector) -> float:
        """Least distance [m] of the moving links from the world over configurations, shape (N, 5)."""
        least = 0.02
        bounds = self.model.geom_rbound
        together = bounds[self._links][:, None] + bounds[self._objects][None]
        for q in positions:
            self.data.qpos[self._columns] = q
            mujoco.mj_kinematics(self.model, self.data)
            places = self.data.geom_xpos
            away = np.linalg.norm(places[self._links][:, None] - places[self._objects][None], axis=2)
            for link, thing in np.argwhere(away - together < least).tolist():
                found = mujoco.mj_geomDistance(
                    self.model, self.data, self._links[link], self._objects[thing], least, None
                )
                least = min(least, found)
        return least


def motion_of(result: PlanResult) -> Motion:
    points = result.trajectory.points
    states = np.array([(point.positions, point.velocities, point.accelerations) for point in points])
    return Motion(np.array([point.time_from_start_ns for point in points]) / 1e9, *states.swapaxes(0, 1))


WORST: dict[str, float] = {}
"""Of all kinds: the least clearance and the greatest ratios; the problems solved, together."""


def prove(maker: Maker, problem: Problem, seconds: float) -> list[list[int]] | None:
    """A solution of a problem by a search of its own, in mrad."""
    lower, upper = so101().lower[:5], so101().upper[:5]
    space = Space(maker.checks(problem.world), lower, upper, 0.005)
    rng = np.random.default_rng(1000 + problem.seed)
    until = time.monotonic() + seconds
    path = connect(space, problem.start, [problem.goal], rng, lambda: time.monotonic() > until)
    if path is None:
        return None
    return np.round(1000 * np.array(shortened(space, path, rng, PACE))).astype(int).tolist()


def problems(maker: Maker, kind: str, number: int, proofs: dict[str, dict[str, list[list[int]]]]) -> list[Problem]:
    """The first so many problems that have a proof."""
    return [maker.problem(kind, int(seed)) for seed in sorted(proofs.get(kind, {}), key=int)[:number]]


def search_proofs(maker: Maker, kinds: list[str], number: int, seconds: float) -> None:
    proofs = json.loads(PROOFS.read_text()) if PROOFS.exists() else {}
    for kind in kinds:
        found = proofs.setdefault(kind, {})
        seed = max(map(int, found), default=-1) + 1
        while len(found) < number:
            path = prove(maker, maker.problem(kind, seed), seconds)
            if path is None:
                print(f"{kind} {seed}: no solution within {seconds:g} s, left out", flush=True)
            else:
                found[str(seed)] = path
            seed += 1
        PROOFS.write_text(json.dumps(proofs, separators=(",", ":")) + "\n")
        print(f"{kind}: {len(found)} problems of {seed}", flush=True)


@attrs.define
class Figures:
    """What one pipeline made of the problems of a kind; dictionaries by the seeds of the solved ones."""

    walls: dict[int, float] = attrs.field(factory=dict)
    """[s]."""
    cpus: dict[int, float] = attrs.field(factory=dict)
    """[s]."""
    durations: dict[int, float] = attrs.field(factory=dict)
    """Of the motions [s]."""
    failed: list[tuple[int, str]] = attrs.field(factory=list)
    jerks: list[float] = attrs.field(factory=list)
    clearances: list[float] = attrs.field(factory=list)
    beyond: int = 0
    """Number of motions beyond the limits."""

    def run(self, task: Problem, plan: Callable[[], Motion]) -> Motion | None:
        """Plan, and note the times; None where there is no plan."""
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            motion = plan()
        except (PlanningError, RuntimeError) as error:
            self.failed.append((task.seed, error.code.name if isinstance(error, PlanningError) else str(error)[:60]))
            return None
        self.walls[task.seed] = time.perf_counter() - wall
        self.cpus[task.seed] = time.process_time() - cpu
        self.durations[task.seed] = motion.duration
        return motion

    def check(self, task: Problem, motion: Motion) -> None:
        """Measure limits and clearance."""
        self.jerks.append(motion.jerk)
        positions, velocities, accelerations = motion.sampled(0.001)
        robot = so101()
        self.beyond += bool(
            (np.abs(velocities) > MAX_VELOCITY).any()
            or (np.abs(accelerations) > MAX_ACCELERATION).any()
            or (positions < robot.lower[:5] - 1e-6).any()
            or (positions > robot.upper[:5] + 1e-6).any()
        )
        self.clearances.append(Referee(task.world).clearance(positions))

    def text(self, number: int, first_s: float) -> str:
        """A line about all `number` problems, and how many were solved within `first_s`."""
        within = sum(wall <= first_s for wall in self.walls.values())
        cpu_within = sum(cpu <= first_s for cpu in self.cpus.values())
        return (
            f"solved {len(self.walls)}/{number}, {within} (CPU time: {cpu_within}) within {first_s:g} s; wall"
            f" {_ms(self.walls.values())} ms, CPU {_ms(self.cpus.values())} ms; motion"
            f" {np.median(list(self.durations.values())):.2f} s"
            + (f", jerk {max(self.jerks):.0f} rad/s^3" if self.jerks else "")
            + (f"; clearance {1000 * min(self.clearances):.2f} mm" if self.clearances else "")
            + (f", limits exceeded {self.beyond}" if self.clearances else "")
            + (f"; failed {self.failed[:3]}" if self.failed else "")
        )


def compared(ours: Figures, theirs: Figures) -> tuple[str, dict[str, float]]:
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
    first_s = FIRST_S.get(kind, 1.0)
    ours, theirs = Figures(), Figures()

    def mine(task: Problem) -> None:
        planner.world = task.world
        request = PlanRequest(ARM_JOINTS, task.start, JointGoal(ARM_JOINTS, task.goal))
        motion = ours.run(task, lambda: motion_of(planner.plan(request)))
        if check and motion is not None:
            ours.check(task, motion)

    def other(task: Problem) -> None:
        import planning_roboplan

        scene = planning_roboplan.made(maker, task.world)
        theirs.run(task, lambda: planning_roboplan.plan(scene, task, FIRST_S.get(kind, 5.0)))

    for number, task in enumerate(tasks):
        turns = (mine, other) if beside else (mine,)
        for turn in turns if number % 2 else reversed(turns):
            turn(task)
    print(f"{kind:12s} {ours.text(len(tasks), first_s)}", flush=True)
    good = not ours.failed and not ours.beyond and min(ours.clearances, default=1.0) > CLEARANCE_M
    WORST["solved"] = WORST.get("solved", 0) + len(ours.cpus)
    if ours.clearances:
        WORST["least_clearance_mm"] = min(WORST.get("least_clearance_mm", np.inf), 1000 * min(ours.clearances))
    good &= sum(cpu <= first_s for cpu in ours.cpus.values()) >= 0.95 * len(tasks)
    if beside:
        text, ratios = compared(ours, theirs)
        good &= max(ratios.values()) <= 1
        for name, ratio in ratios.items():
            WORST[f"{name}_ratio"] = max(WORST.get(f"{name}_ratio", 0.0), ratio)
        print(f"{'':12s} roboplan {theirs.text(len(tasks), first_s)}\n{'':12s} {text}", flush=True)
    return good


def _ms(times: Iterable[float]) -> str:
    listed = list(times)
    return f"{1000 * np.median(listed):.1f} (p95 {1000 * np.percentile(listed, 95):.1f})"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--time", type=float, default=60.0, help="of a search [s]")
    parser.add_argument("--prove", action="store_true", help="search for solutions of problems without a stored one")
    parser.add_argument("--no-check", action="store_true", help="do not measure clearance")
    parser.add_argument(
        "--roboplan", action="store_true", help="the same problems by roboplan, which must be installed"
    )
    arguments = parser.parse_args()
    maker, kinds = Maker(), arguments.kinds.split(",")
    if arguments.prove:
        search_proofs(maker, kinds, arguments.problems, arguments.time)
        return 0
    proofs = json.loads(PROOFS.read_text())
    good = True
    for kind in kinds:
        tasks = problems(maker, kind, arguments.problems, proofs)
        good &= measure(maker, kind, tasks, arguments.time, check=not arguments.no_check, beside=arguments.roboplan)
    report(**WORST)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
