"""A plugin for tests: planners in the manner of cuRobo and VAMP, which are not installed with ibrobot.

Both see the world as spheres, plan many goals in a batch, and give positions at a fixed time step.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import override

import attrs
import numpy as np
from ibrobot_kinematics import KinematicsError, Target, robot_model, solve_all
from ibrobot_planning.planner import (
    AnyGoal,
    JointGoal,
    NamedGoal,
    Planner,
    PlannerDescriptor,
    PlanRequest,
    PlanResult,
    PoseGoal,
    PositionGoal,
)
from ibrobot_planning.world.objects import Box, Sphere, World

from ibrobot_core.api import (
    Context,
    Header,
    JointTrajectory,
    JointTrajectoryPoint,
    Options,
    PlanCode,
    PlanningError,
    Pose,
    Vector,
    documented,
    hookimpl,
    ns,
    option,
)

DT = 0.02


@documented
@attrs.frozen
class BatchOptions(Options):
    """Options of both planners."""

    batch: int = option(8, ge=1, help="goals planned at once")
    device: str = option("cpu", help="where it runs")


class BatchPlanner(Planner):
    """Straight lines in joint space past spheres: not good, but in every respect another planner."""

    def __init__(self, options: BatchOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self.warm = False

    @override
    def load(self) -> None:
        self.warm = True  # as a GPU planner compiles its kernels

    @override
    def close(self) -> None:
        self.warm = False

    @override
    def plan(self, request: PlanRequest) -> PlanResult:
        assert self.warm, "load comes first"
        goals = request.goal.goals if isinstance(request.goal, AnyGoal) else (request.goal,)
        for number, goal in enumerate(goals[: self._options.batch]):
            for end in self._configurations(goal, request):
                trajectory = self._line(request, end)
                if trajectory is not None:
                    return PlanResult(trajectory, alternative=number)
        raise PlanningError("every line to a goal touches a sphere", PlanCode.PLANNING_FAILED)

    def _configurations(self, goal: object, request: PlanRequest) -> Iterator[Vector]:
        robot, start = self._ctx.robot, request.start
        order = robot.indices(request.joints)
        match goal:
            case NamedGoal(name=name) if name in robot.description.poses:
                yield robot.pose(name)[order]
            case JointGoal(joints=joints, positions=positions):
                end = start.copy()
                for joint, value in zip(joints, positions.tolist(), strict=True):
                    if joint not in request.joints:
                        raise PlanningError(f"joint {joint} is not planned", PlanCode.INVALID_GOAL_CONSTRAINTS)
                    end[request.joints.index(joint)] = value
                outside = (end < robot.lower[order]) | (end > robot.upper[order]) | ~np.isfinite(end)
                if outside.any():
                    joint = request.joints[int(outside.argmax())]
                    raise PlanningError(
                        f"goal of joint {joint} is outside its limits", PlanCode.INVALID_GOAL_CONSTRAINTS
                    )
                yield end
            case PositionGoal(position=p) | PoseGoal(pose=Pose(position=p)):
                whole = np.zeros(len(robot.joints))
                whole[order] = start
                try:
                    found = solve_all(robot_model(robot), Target(np.array([p.x, p.y, p.z])), whole)
                except KinematicsError as error:
                    raise PlanningError(str(error), PlanCode.NO_IK_SOLUTION) from error
                yield from (q[order] for q in found)
            case _:
                raise PlanningError(f"goals like {type(goal).__name__} are unknown", PlanCode.UNRECOGNIZED_GOAL_TYPE)

    def _line(self, request: PlanRequest, end: Vector) -> JointTrajectory | None:
        robot, way = self._ctx.robot, end - request.start
        order = robot.indices(request.joints)
        velocity = robot.max_velocity[order] * request.velocity_scaling
        acceleration = robot.max_acceleration[order] * request.acceleration_scaling
        # A quintic from rest to rest reaches 1.875 of its mean speed, and 5.774 of way / time**2.
        duration = max(
            float((1.875 * np.abs(way) / velocity).max()), float(np.sqrt(5.774 * np.abs(way) / acceleration).max()), DT
        )
        count = int(np.ceil(duration / DT)) + 1
        s = np.linspace(0, 1, count)[:, None]
        positions = request.start + way * (10 * s**3 - 15 * s**4 + 6 * s**5)
        duration = (count - 1) * DT
        velocities = way * (30 * s**2 - 60 * s**3 + 30 * s**4) / duration
        accelerations = way * (60 * s - 180 * s**2 + 120 * s**3) / duration**2
        if self._touches(request, positions):
            return None
        points = tuple(
            JointTrajectoryPoint(ns(i * DT), *each)
            for i, each in enumerate(zip(positions, velocities, accelerations, strict=True))
        )
        return JointTrajectory(Header(), request.joints, points)

    def _touches(self, request: PlanRequest, positions: Vector) -> bool:
        """Whether the tip touches a sphere of the world: the run's bus has the world, as for any planner."""
        bus, robot = self._ctx.bus, self._ctx.robot
        if bus is None or not bus.serves("/world/snapshot"):
            return False
        world = bus.call("/world/snapshot", None)
        assert isinstance(world, World)
        whole = np.zeros((len(positions), len(robot.joints)))
        whole[:, robot.indices(request.joints)] = positions
        tips = robot_model(robot).forward(whole).position
        for thing in world.objects.values():
            radius = thing.shape.radius if isinstance(thing.shape, Sphere) else 0.0
            radius = max(thing.shape.size) / 2 if isinstance(thing.shape, Box) else radius
            p = thing.pose.position
            if (np.linalg.norm(tips - [p.x, p.y, p.z], axis=1) < radius).any():
                return True
        return False


@hookimpl
def ibrobot_planners() -> Iterator[PlannerDescriptor]:
    for name in ("curobo", "vamp"):
        yield PlannerDescriptor(name, BatchPlanner, f"like {name}", BatchOptions)
