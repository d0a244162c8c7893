"""Plans around obstacles: success, times, clearance and limits, on five kinds of scenes with the SO-101.

    python benchmarks/planning.py [--problems N] [--kinds table_pick,cage] [--time S] [--roboplan]

Every problem was solved before by a long search (`--prove` searches for more). MuJoCo measures the clearance of every
timed trajectory at each millisecond, with shapes of its own making.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
from ibrobot_planning.options import RrtConnectOptions
from ibrobot_planning.rrt import RrtConnectPlanner
from ibrobot_planning.search import Space, connect, shortened
from ibrobot_planning.timing import Motion
from ibrobot_planning.transforms import matrix
from ibrobot_planning.world import Box, Cylinder, World
from planning_scenes import ARM_JOINTS, KINDS, MAX_ACCELERATION, MAX_VELOCITY, MJCF, PADDING_M, Maker, Problem, so101

from ibrobot_core.api import Context, JointGoal, PlanningError, PlanRequest, PlanResult, SteppedClock, Vector

PROOFS = Path(__file__).with_name("planning_proofs.json")
"""Kind -> seed -> a path that solves the problem [mrad]."""
LONG_S = {"cage": 60.0}
FIRST_S = {"cage": 10.0}
CLEARANCE_M = 0.0049


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
            i for i in range(self.model.ngeom)
            if i not in self._objects and self.model.geom_bodyid[i] != still
            and (self.model.geom_contype[i] or self.model.geom_conaffinity[i])
        ]  # fmt: skip
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


def prove(maker: Maker, problem: Problem, seconds: float) -> list[list[int]] | None:
    """A solution of a problem by a search of its own, in mrad."""
    lower, upper = so101().lower[:5], so101().upper[:5]
    space = Space(maker.checks(problem.world), lower, upper, 0.005)
    rng = np.random.default_rng(1000 + problem.seed)
    until = time.monotonic() + seconds
    path = connect(space, problem.start, [problem.goal], rng, lambda: time.monotonic() > until)
    if path is None:
        return None
    return np.round(1000 * np.array(shortened(space, path, rng))).astype(int).tolist()


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


def measure(maker: Maker, kind: str, tasks: list[Problem], seconds: float, check: bool) -> bool:
    context = Context("benchmark", SteppedClock(0), logging.getLogger("benchmark"), so101())
    planner = RrtConnectPlanner(RrtConnectOptions(padding=PADDING_M, planning_time=seconds), context)
    planner.load()
    walls, cpus, durations, jerks, clearances = [], [], [], [], []
    failed, beyond = [], 0
    for task in tasks:
        planner.world = task.world
        request = PlanRequest(ARM_JOINTS, task.start, JointGoal(ARM_JOINTS, task.goal))
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            result = planner.plan(request)
        except PlanningError as error:
            failed.append((task.seed, error.code.name))
            continue
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
        motion = motion_of(result)
        durations.append(motion.duration)
        jerks.append(motion.jerk)
        if check:
            positions, velocities, accelerations = motion.sampled(0.001)
            robot = so101()
            beyond += bool(
                (np.abs(velocities) > MAX_VELOCITY).any() or (np.abs(accelerations) > MAX_ACCELERATION).any()
                or (positions < robot.lower[:5] - 1e-6).any() or (positions > robot.upper[:5] + 1e-6).any()
            )  # fmt: skip
            clearances.append(Referee(task.world).clearance(positions))
    within = sum(wall <= FIRST_S.get(kind, 1.0) for wall in walls)
    cpu_within = sum(cpu <= FIRST_S.get(kind, 1.0) for cpu in cpus)
    print(
        f"{kind:12s} solved {len(walls)}/{len(tasks)} in {seconds:g} s, {within} (CPU time: {cpu_within}) within"
        f" {FIRST_S.get(kind, 1.0):g} s; wall {_ms(walls)} ms, CPU {_ms(cpus)} ms; motion {np.median(durations):.2f} s,"
        f" jerk {max(jerks):.0f} rad/s^3"
        + (f"; clearance {1000 * min(clearances):.2f} mm, limits exceeded {beyond}" if check else "")
        + (f"; failed {failed}" if failed else ""),
        flush=True,
    )
    return not failed and cpu_within >= 0.95 * len(tasks) and not beyond and min(clearances, default=1.0) > CLEARANCE_M


def _ms(times: list[float]) -> str:
    return f"{1000 * np.median(times):.0f} (p95 {1000 * np.percentile(times, 95):.0f})"


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
        good &= measure(maker, kind, tasks, arguments.time, not arguments.no_check)
        if arguments.roboplan:
            from planning_roboplan import measure_roboplan

            measure_roboplan(maker, kind, tasks, FIRST_S.get(kind, 5.0))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
