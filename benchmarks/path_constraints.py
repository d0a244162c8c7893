"""Plans under path constraints, around obstacles: how many are solved, how fast, and whether they keep the constraints.

    python benchmarks/path_constraints.py [--problems 200] [--first 10000] [--arms so101,ur5,fr3] [--kinds upright,…]

An SO-101 (five joints), a UR5 (six) and an FR3 (seven) carry something upright within 10 degrees. Fewer problems ask
for a region, for a point in view, and for upright in a region. Each problem is solvable by construction: a random walk
that keeps the constraint within 8 degrees (or 80 % of a region), and 1.2 times the padding, leads from its start to its
goal. The straight line between them breaks the constraint or touches something, and so does its projection onto the
constraint. Every second goal is the tool's position alone. Problems of the seeds from 10000 on were not used while the
planner was written. Those with an upright constraint are also planned without, to count the plans that break it.

MuJoCo's own kinematics of the model measures the constraint at each millisecond of the timed motion, and its own
distances the clearance from the obstacles.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import planning_scenes as scenes
from apparatus import CONFIGS, report
from guard_trials import new_robot
from ibrobot_kinematics import KinematicModel, PathConstraints, ToolConstraints, robot_model
from ibrobot_kinematics.path_constraints import AXES, direction
from ibrobot_planning.planner import ConstrainedGoal, JointGoal, PlanRequest, PositionGoal
from ibrobot_planning.planners.constrained import ConstrainedChecks, ConstrainedSpace
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.planners.timing import motion_of
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import World
from planning import Plans
from referee import Referee

from ibrobot_core.api import Context, PlanningError, Robot, SteppedClock, Vector, Vector3
from ibrobot_core.app import load_config

ARMS = {"so101": 68, "ur5": 66, "fr3": 66}
"""Arm -> its problems among 200."""
KINDS = {"upright": 1.0, "region": 0.08, "view": 0.08, "upright in a region": 0.08}
"""Kind -> its problems, as a share of those with an upright constraint."""
TOLERANCE_RAD, WITNESS = math.radians(10.0), 0.8
"""The upright constraint, and the share of every tolerance that the known solution keeps."""
PADDING_M, CLEARANCE_M = 0.005, 0.0049
WITHIN_S, LONGEST_S = 5.0, 60.0
"""Time in which a problem is to be solved, and when a search ends: others may use the processor meanwhile."""
FIRST_SEED = 10_000
_BEGINS, _STEPS = 30, 80
"""Samples of the start of a walk, and its steps."""
_FARTHER_RAD, _FARTHER_M = 1.8, 0.4
"""Least distance between start and goal, of the joints, and of the tool as a share of the reach."""

type Random = np.random.Generator


@attrs.frozen(eq=False)
class Problem(scenes.Problem):
    """From `start` to `goal`, both shape (J,) [rad], in `world`, under constraints."""

    constraints: PathConstraints


class Station:
    """An arm with its planner, and a maker of problems for it."""

    def __init__(self, name: str, robot: Robot) -> None:
        self.name, self.robot = name, robot
        self.model: KinematicModel = robot_model(robot)
        self.joints = tuple(self.model.joint_names[i] for i in self.model.moving)
        self.order = self.model.moving
        context = Context("benchmark", SteppedClock(0), logging.getLogger("benchmark"), robot)
        self.planner = RrtConnectPlanner(RrtConnectOptions(padding=PADDING_M, planning_time=LONGEST_S), context)
        self.planner.load()
        self.lower, self.upper = robot.lower[self.order], robot.upper[self.order]
        self._rest = np.clip(np.zeros(len(robot.joints)), robot.lower, robot.upper)
        size = np.random.default_rng(0).uniform(robot.lower, robot.upper, (2000, len(robot.joints)))
        self.reach = float(np.percentile(np.linalg.norm(self.model.forward(size).position, axis=1), 95))

    def problem(self, kind: str, seed: int) -> Problem:
        """Problem number `seed` of a kind."""
        rng = np.random.default_rng([sorted(ARMS).index(self.name), sorted(KINDS).index(kind), seed])
        while True:
            world = self._world(rng)
            constraints = self._constraints(kind, rng)
            wide = Collisions(self.planner.arm, world, self.joints, padding=1.2 * PADDING_M)
            witness = self._space(wide, narrowed(constraints), 0.01)
            ends = self._walk(witness, rng)
            if ends is None:
                continue
            start, goal = ends
            checks = Collisions(self.planner.arm, world, self.joints, padding=PADDING_M)
            space = self._space(checks, constraints, 0.01)
            if space.free(start, goal):
                continue
            curve = space.curve(start, goal)
            if len(curve) and np.array_equal(curve[-1], goal):
                continue
            return Problem(kind, seed, world, start, goal, constraints)

    def _space(self, contacts: Collisions, constraints: PathConstraints, resolution: float) -> ConstrainedSpace:
        tool = ToolConstraints(constraints, self.model, self._rest)
        checks = ConstrainedChecks(contacts, tool, self._rest, self.order)
        return ConstrainedSpace(checks, self.lower, self.upper, resolution, constrained=checks)

    def _world(self, rng: Random) -> World:
        """A table with boxes and posts on it, at distances where the tool works."""
        top = self.robot.description.floor  # a planner keeps above this, too
        low = -0.03 if top is None else top - 0.01
        things = {"table": scenes.box(0.0, 0.0, low, 3 * self.reach, 3 * self.reach, 0.02)}
        for i in range(int(rng.integers(4, 8))):
            heading, away = rng.uniform(-2.4, 2.4), self.reach * rng.uniform(0.45, 0.95)
            wide, deep = self.reach * rng.uniform(0.04, 0.16, 2)
            tall = self.reach * rng.uniform(0.15, 0.7)
            lifted = self.reach * rng.uniform(0.2, 0.5) if rng.random() < 0.3 else 0.0
            place = away * np.cos(heading), away * np.sin(heading), lifted + tall / 2
            things[f"box_{i}"] = scenes.box(*place, wide, deep, tall, rng.uniform(0, np.pi))
        return World(things)

    def _constraints(self, kind: str, rng: Random) -> PathConstraints:
        upright: dict[str, Any] = {"upright": TOLERANCE_RAD, "upright_axis": str(rng.choice(AXES))}
        middle = self.reach * np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.3, 0.6)])
        half = self.reach * rng.uniform(0.25, 0.5, 3)
        region = (*(middle - half).tolist(), *(middle + half).tolist())
        if kind == "upright":
            return PathConstraints(**upright)
        if kind == "region":
            return PathConstraints(region=region)
        if kind == "view":
            camera = np.array([0.0, 0.05 * self.reach, -0.05 * self.reach])
            point = np.full(3, -1.0)
            while not 0 < point[2] < 0.4 * self.reach:  # what the camera sees on the table or above, from somewhere
                whole = self._rest.copy()
                whole[self.order] = rng.uniform(self.lower, self.upper)
                tip = self.model.forward(whole)
                ahead = rng.uniform(0.3, 0.6) * self.reach * tip.rotation[:, 2]
                point = tip.position + tip.rotation @ camera + ahead
            x, y, z = point.tolist()
            return PathConstraints(
                view=(x, y, z), view_angle=math.radians(20.0), view_from=(0.0, float(camera[1]), float(camera[2]))
            )
        return PathConstraints(**upright, region=region)

    def _walk(self, space: ConstrainedSpace, rng: Random) -> tuple[Vector, Vector] | None:
        """The ends of a random walk that keeps the constraint, far from each other; None if there is none."""
        begin = next((q for q in self._kept(space, rng, _BEGINS) if space.constrained.free(q)), None)
        if begin is None:
            return None
        here = start = begin
        for target in self._kept(space, rng, _STEPS):
            for point in space.curve(here, target):
                here = point
            apart = np.linalg.norm(here - start)
            moved = np.linalg.norm(self._tip(here) - self._tip(start))
            if apart > _FARTHER_RAD and moved > _FARTHER_M * self.reach:
                return start, np.clip(here, self.lower, self.upper)  # interpolation rounds
        return None

    def _kept(self, space: ConstrainedSpace, rng: Random, number: int) -> Vector:
        inner = 0.97 * (self.upper - self.lower) / 2
        middle = (self.upper + self.lower) / 2
        return space.kept(middle + rng.uniform(-1, 1, (number, len(self.joints))) * inner)

    def _tip(self, q: Vector) -> Vector:
        whole = self._rest.copy()
        whole[self.order] = q
        return self.model.forward(whole).position


def narrowed(given: PathConstraints) -> PathConstraints:
    """Constraints with less room, which the known solution keeps."""
    region = given.region
    if region is not None:
        low, high = np.array(region[:3]), np.array(region[3:])
        middle, half = (low + high) / 2, WITNESS * (high - low) / 2
        region = (*(middle - half).tolist(), *(middle + half).tolist())
    upright = None if given.upright is None else WITNESS * given.upright
    return attrs.evolve(
        given, upright=upright, region=region, view_angle=WITNESS * given.view_angle if given.view else given.view_angle
    )


def off(given: PathConstraints, place: Vector, axes: Vector) -> dict[str, float]:
    """By how much each constraint is exceeded [rad or m], from the pose of the tool; not positive if it is kept."""
    found = {}
    if given.upright is not None:
        assert given.upright_axis is not None
        cosine = float((axes @ direction(given.upright_axis))[2])
        found["upright"] = math.acos(min(max(cosine, -1.0), 1.0)) - given.upright
    if given.region is not None:
        low, high = np.array(given.region[:3]), np.array(given.region[3:])
        found["region"] = float(max((place - high).max(), (low - place).max()))
    if given.view is not None:
        way = np.array(given.view) - (place + axes @ given.view_from)
        cosine = float((axes @ direction(given.view_axis)) @ way / np.linalg.norm(way))
        found["view"] = math.acos(min(max(cosine, -1.0), 1.0)) - given.view_angle
    return found


@attrs.define
class Kept(Plans):
    """Plans under constraints, and whether they keep them."""

    slack: float = 1.001
    number: int = 0
    violations: int = 0
    """Milliseconds in which a constraint is broken."""
    milliseconds: int = 0
    worst: float = -math.inf
    """Greatest excess [rad or m]."""
    broken_without: int = 0
    """Plans without the constraint that break it."""

    def solve(self, station: Station, task: Problem) -> None:
        """Plan, and measure the motion."""
        self.number += 1
        station.planner.world = task.world
        goal: JointGoal | PositionGoal = JointGoal(station.joints, task.goal)
        if task.seed % 2:
            goal = PositionGoal(Vector3(*station._tip(task.goal).tolist()))
        request = PlanRequest(station.joints, task.start, ConstrainedGoal(goal, task.constraints))
        name = f"{station.name} {task.kind} {task.seed}"
        motion = self.run(name, station.planner, request)
        if motion is None:
            return
        positions = self.check(station.robot, station.order.tolist(), motion)
        assert station.robot.description.mjcf is not None
        referee = Referee(station.robot.description.mjcf, station.joints, task.world, station.model.tip)
        for place, axes in referee.poses(positions):
            most = max(off(task.constraints, place, axes).values())
            self.worst = max(self.worst, most)
            self.violations += most > 0
        self.clearance = min(self.clearance, referee.clearance(positions[::5]))
        self.milliseconds += len(positions)
        if task.kind != "upright":
            return
        try:
            free = motion_of(station.planner.plan(attrs.evolve(request, goal=goal)).trajectory)
        except PlanningError:
            return
        assert free is not None
        poses = referee.poses(free.sampled(0.01)[0])
        self.broken_without += any(max(off(task.constraints, *pose).values()) > 0 for pose in poses)

    def say(self) -> str:
        """One line."""
        return (
            f"{self.text(self.number, WITHIN_S)}; {self.violations} of {self.milliseconds} ms break a constraint,"
            f" nearest {self.worst:.2g} rad or m; without the constraint, {self.broken_without} plans break it"
        )


def made(name: str, folder: Path) -> Station:
    """The station of an arm; the YAMLs of the UR5 and the FR3 are written to a folder."""
    path = CONFIGS / "so101_blind.yaml"
    if name != "so101":
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            path = new_robot(folder, {"ur5": "ur5_gripper.urdf", "fr3": "fr3.urdf"}[name])
    return Station(name, load_config(path, sim=True).robot)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=200, help="with an upright constraint, of all arms together")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument("--kinds", default=",".join(KINDS))
    arguments = parser.parse_args()
    upright, others = both = Kept(), Kept()
    with tempfile.TemporaryDirectory() as folder:
        stations = [made(name, Path(folder)) for name in arguments.arms.split(",")]
        for kind in arguments.kinds.split(","):
            kept = upright if kind == "upright" else others
            for station in stations:
                number = math.ceil(ARMS[station.name] * KINDS[kind] * arguments.problems / 200)
                for seed in range(arguments.first, arguments.first + number):
                    kept.solve(station, station.problem(kind, seed))
                print(f"to {kind}, {station.name}: {kept.say()}", flush=True)
    for name, failure in (*upright.failed, *others.failed):
        print(f"no plan: {name}: {failure}")
    report(
        upright_solved_within_5_s=upright.within(WITHIN_S)[0],
        upright_within_5_s_by_the_clock=upright.within(WITHIN_S)[1],
        upright_problems=upright.number,
        upright_broken_without_constraint=upright.broken_without,
        others_solved_within_5_s=others.within(WITHIN_S)[0],
        others_problems=others.number,
        violations=sum(each.violations for each in both),
        milliseconds=sum(each.milliseconds for each in both),
        greatest_cpu_s=max((*upright.cpus.values(), *others.cpus.values()), default=math.nan),
        least_clearance_mm=1000 * min(each.clearance for each in both),
    )
    good = all(
        each.within(WITHIN_S)[0] == each.number and not each.violations and not each.beyond
        and each.clearance > CLEARANCE_M
        for each in both
    )  # fmt: skip
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
