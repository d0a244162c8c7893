"""Goals of a mode, divided among its executors, and planned by its planner."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import attrs
import numpy as np
from ibrobot_kinematics import PathConstraints, robot_model
from ibrobot_kinematics.path_constraints import KINDS

from ibrobot_core.api import (
    ExecutorGoal,
    FollowTrajectory,
    IbrobotError,
    JointTrajectory,
    MoveJoint,
    PlanCode,
    PlanningError,
    Vector,
    ns,
)
from ibrobot_core.app import ControlMode, RobotConfig, RunView
from ibrobot_planning.execution.motions import commanded
from ibrobot_planning.goals.grammar import GoalOptions, Target, without_names
from ibrobot_planning.goals.tool import Tool
from ibrobot_planning.planner import (
    AnyGoal,
    ConstrainedGoal,
    Goal,
    JointGoal,
    Planner,
    PlannerDescriptor,
    PlanRequest,
    PlanResult,
    invalid_goal,
)
from ibrobot_planning.planners.completion import Start, check_size, completed
from ibrobot_planning.world.objects import World, world_of

_GLANCE_S = 0.02
"""Interval at which a request that waits for the planner looks whether it is still wanted [s]."""


class GoalPlans:
    """Plans goals for the executors of a mode.

    Args:
        session: the run.
        mode: a mode with a planner.

    Attributes:
        planner: the mode's planner, once `make` was called.
    """

    planner: Planner

    def __init__(self, session: RunView, mode: ControlMode) -> None:
        self._session = session
        self._mode = mode
        self._lock = threading.Lock()
        """Held while the planner plans."""
        self.era = 0
        """How often `drop` was called: plans for goals of earlier eras are not wanted any more."""
        self._moves = False
        """Whether a plan for a motion is made, or waits for the planner."""

    def make(self) -> Planner:
        """Make the planner, without loading it."""
        assert self._mode.planner is not None
        self.planner = self._session.make("planner", self._mode.planner, self._mode.planner.type)
        return self.planner

    @cached_property
    def tool(self) -> Tool:
        """Inverse kinematics of the tool.

        Raises:
            KinematicsError: without a model of the robot.
        """
        return Tool(robot_model(self._session.config.robot))

    def surroundings(self, goals: Sequence[GoalOptions], start: Vector) -> tuple[World, Vector | None]:
        """The objects if a goal is relative to one, and the position of the tool [m], shape (3,), at `start` likewise.

        Raises:
            PlanningError: if the objects are too old.
        """
        world = world_of(self._session.bus) if any(each.object is not None for each in goals) else World()
        relative = any(each.relative for each in goals)
        return world, self.tool.model.forward(start).position if relative else None

    def any_goal(self, goals: Sequence[GoalOptions], start: Vector) -> Goal:
        """The only goal, or all as alternatives.

        Raises:
            PlanningError: without goals, or as `GoalOptions.goal`.
        """
        if not goals:
            raise invalid_goal("a request needs at least one goal")
        place = self.surroundings(goals, start)
        return goals[0].goal(*place) if len(goals) == 1 else AnyGoal(tuple(each.goal(*place) for each in goals))

    def check(self, target: Target) -> None:
        """Check that the mode takes goals of this kind.

        Raises:
            PlanningError: if the planner does not take such goals, or no executor of the mode can reach it.
        """
        takes = tool_planners(self._session.registry.of_kind("planner"))
        assert self._mode.planner is not None
        of_tool = target.constraints is not None or not isinstance(target.tool, JointGoal | None)
        if of_tool and self._mode.planner.type not in takes:
            raise PlanningError(
                f"goal {target.text!r}: planner type {self._mode.planner.type!r} of mode {self._mode.name} takes joint"
                f" positions only; types that take other goals: {', '.join(takes) or 'none is installed'}",
                PlanCode.UNRECOGNIZED_GOAL_TYPE,
            )
        self.divided(target)

    def divided(self, target: Target) -> dict[str, Goal | float | JointTrajectory]:
        """Executor -> its part of a goal: a goal to plan for, a position [rad], or a trajectory to follow.

        Raises:
            PlanningError: if no executor of the mode can reach the goal.
        """
        executors = {name: self._session.config.executors[name] for name in self._mode.executors}
        parts: dict[str, Goal | float | JointTrajectory] = {}
        if (trajectory := target.trajectory) is not None:
            wanted = sorted(trajectory.joint_names)
            arms = [
                name for name, each in executors.items() if each.goals == "trajectory" and sorted(each.joints) == wanted
            ]
            if not arms:
                raise PlanningError(
                    f"no executor of mode {self._mode.name} follows trajectories of"
                    f" {', '.join(trajectory.joint_names)}",
                    PlanCode.INVALID_GROUP_NAME,
                )
            return {arms[0]: trajectory}
        for name, executor in executors.items():
            mine = [joint for joint in executor.joints if joint in target.joints]
            if mine and executor.goals == "position":
                parts[name] = target.joints[mine[0]]
            elif mine:
                goal = JointGoal(tuple(mine), np.array([target.joints[joint] for joint in mine]))
                parts[name] = goal if target.constraints is None else ConstrainedGoal(goal, target.constraints)
        constraints = target.tool.constraints if isinstance(target.tool, ConstrainedGoal) else target.constraints
        if constraints is not None:
            self._check_constrained(target, constraints, parts)
        if target.tool is None:
            return parts
        arms = [name for name, executor in executors.items() if executor.goals == "trajectory"]
        if len(arms) != 1:
            raise PlanningError(
                f"goal {target.text!r}: mode {self._mode.name} has {len(arms)} executors of trajectories,"
                " a goal of the tool needs one",
                PlanCode.INVALID_GROUP_NAME,
            )
        joints = executors[arms[0]].joints
        if arms[0] in parts:
            both = ", ".join(joint for joint in target.joints if joint in joints)
            raise invalid_goal(f"goal {target.text!r}: {both} moves the tool, and cannot be given beside its position")
        return {arms[0]: target.tool, **parts}

    def _check_constrained(
        self, target: Target, constraints: PathConstraints, parts: Mapping[str, Goal | float | JointTrajectory]
    ) -> None:
        """Check that a way is planned, and that no executor moves the tool to a position without one.

        Raises:
            PlanningError: if the constraints could not be kept.
        """
        model = self.tool.model
        movers = {model.joint_names[i] for i in model.moving}
        executors = self._session.config.executors
        alone = [executors[name].joints[0] for name, part in parts.items() if isinstance(part, float)]
        wrong = [joint for joint in alone if joint in movers]
        if not wrong and (target.tool is not None or len(alone) < len(parts)):
            return
        which = ", ".join(wrong or alone)
        key = next(key for key in KINDS if getattr(constraints, key) is not None)
        raise invalid_goal(
            f"goal {target.text!r}: {key} holds on a planned way, but {which} goes to its position without a plan:"
            f" leave {key} out, or give {which} an executor of trajectories with the other joints of the arm"
        )

    def drop(self) -> None:
        """End every search under way, and every wait for the planner, with the code PREEMPTED."""
        self.era += 1

    def plan(
        self, target: Target, start: Vector, *, era: int | None = None
    ) -> tuple[dict[str, ExecutorGoal], PlanResult | None]:
        """Plan a goal.

        Args:
            target: the goal.
            start: positions of all joints [rad], shape (J,), from which the motion begins.
            era: the era in which a motion to the goal was wanted; None: nothing is to move.

        Returns:
            Executor -> its goal, and the plan; None if nothing had to be planned.

        Raises:
            PlanningError: with MoveIt's code.
        """
        robot = self._session.config.robot
        wanted = self.divided(target)
        if not wanted:
            raise PlanningError(f"goal {target.text!r}: no executor of mode {self._mode.name} has these joints")
        goals: dict[str, ExecutorGoal] = {}
        planned = None
        for name, goal in wanted.items():
            if isinstance(goal, float):
                goals[name] = MoveJoint(goal)
                continue
            others = dict(zip(robot.joint_names, start.tolist(), strict=True))
            if isinstance(goal, JointTrajectory):
                check_size(goal)
                trajectory = goal
            else:
                joints = self._session.config.executors[name].joints
                first, scalings = start[robot.indices(joints)], (target.velocity_scaling, target.acceleration_scaling)
                planned = self.planned(PlanRequest(joints, first, goal, *scalings, others), era=era)
                trajectory = planned.trajectory
            goals[name] = FollowTrajectory(self._completed(trajectory, start))
        return goals, planned

    def _completed(self, trajectory: JointTrajectory, start: Vector) -> JointTrajectory:
        """Complete a trajectory from where the joints are, or will be.

        Raises:
            PlanningError: as `completed`.
        """
        robot, config = self._session.config.robot, self._session.config
        order = robot.indices(trajectory.joint_names)
        begin = Start(start[order])
        if self._session.state is not None and np.array_equal(start, commanded(self._session)):
            begin = Start(start[order], measured=self._session.measured().position[order])
        return completed(trajectory, begin, robot, ns(1.0 / config.control.rate_hz))

    def planned(self, request: PlanRequest, *, era: int | None = None) -> PlanResult:
        """Plan by the mode's planner, one request at a time; what is to move comes before what is not.

        Args:
            request: the request.
            era: as for `plan`.

        Raises:
            PlanningError: with MoveIt's code; PREEMPTED after `drop`, and if a plan for a motion takes its place.
        """
        moves, era = era is not None, self.era if era is None else era

        def check_wanted() -> None:
            if self.era != era:
                raise PlanningError("cancelled", PlanCode.PREEMPTED)
            if self._moves and not moves:
                raise PlanningError("the planner plans a motion instead: ask again", PlanCode.PREEMPTED)

        goal = without_names(request.goal, self._session.config.robot, request.joints)
        speed = min(request.velocity_scaling, self._session.authority.speed)
        request = attrs.evolve(request, goal=goal, velocity_scaling=speed, check_wanted=check_wanted)
        if not moves:
            return self._plan(request)
        self._moves = True  # only the thread that moves the robot comes here
        try:
            return self._plan(request)
        finally:
            self._moves = False

    def _plan(self, request: PlanRequest) -> PlanResult:
        request.check_wanted()
        while not self._lock.acquire(timeout=_GLANCE_S):
            request.check_wanted()
        try:
            plan = self._plan_alone(request)
        finally:
            self._lock.release()
        request.check_wanted()
        return plan

    def _plan_alone(self, request: PlanRequest) -> PlanResult:
        try:
            return self.planner.plan(request)
        except IbrobotError:
            raise
        except Exception as error:
            # A planner's bug must not end the run of a robot.
            self._session.log.exception("a bug of planner %s; please report it", type(self.planner).__name__)
            raise PlanningError(f"the planner failed: {type(error).__name__}: {error}", PlanCode.FAILURE) from error


def tool_planners(planners: Iterable[object]) -> list[str]:
    """The types of planners that take goals of the tool, of the descriptors of planners."""
    return [each.type for each in planners if isinstance(each, PlannerDescriptor) and each.tool_goals]


def arm_joints(config: RobotConfig, mode: ControlMode) -> tuple[str, ...]:
    """The joints of the arm.

    Raises:
        PlanningError: unless the mode has exactly one executor of trajectories.
    """
    executors = [config.executors[name] for name in mode.executors]
    arms = [executor.joints for executor in executors if executor.goals == "trajectory"]
    if len(arms) != 1:
        raise PlanningError(
            f"mode {mode.name} has {len(arms)} executors of trajectories, planning needs one",
            PlanCode.INVALID_GROUP_NAME,
        )
    return arms[0]
