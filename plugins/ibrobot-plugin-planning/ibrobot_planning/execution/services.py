"""Services that plan and compute without moving, under MoveIt's names."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np
from ibrobot_kinematics import ToolConstraints

from ibrobot_core.api import Header, IbrobotError, JointState, PlanCode, PlanningError, PoseStamped, Vector
from ibrobot_core.app import ControlMode, NoRequest, RunView, Service
from ibrobot_planning.execution.motions import commanded
from ibrobot_planning.execution.plans import GoalPlans, arm_joints
from ibrobot_planning.execution.requests import (
    CartesianQuery,
    FkAnswer,
    FkQuery,
    IkAnswer,
    IkQuery,
    ObjectSummary,
    PlanAhead,
    PlanAnswer,
    PlanningScene,
    PlanQuery,
)
from ibrobot_planning.goals.grammar import line_goal, target
from ibrobot_planning.goals.tool import Candidate
from ibrobot_planning.planner import Goal, PlanRequest, PlanResult, invalid_goal
from ibrobot_planning.planners.options import RrtConnectOptions
from ibrobot_planning.world.engines import find_engines
from ibrobot_planning.world.objects import observed_world, world_of

if TYPE_CHECKING:
    from ibrobot_planning.world.arm import Arm

COMPUTE_IK = Service(
    "/compute_ik", IkQuery, IkAnswer, "Joint positions for a position or pose of the tool.", reads=True
)
COMPUTE_FK = Service("/compute_fk", FkQuery, FkAnswer, "Poses of links.", reads=True)
PLAN = Service(
    "/plan_kinematic_path",
    PlanQuery,
    PlanAnswer,
    "Plan to the first goal that can be reached, without moving.",
    reads=True,
)
PLAN_GOAL = Service(
    "/planning/plan", PlanAhead, PlanAnswer, "Plan to a goal, without moving.", alone="goal", reads=True
)
CARTESIAN = Service(
    "/compute_cartesian_path",
    CartesianQuery,
    PlanAnswer,
    "Plan straight lines of the tool through waypoints.",
    reads=True,
)
SCENE = Service("/get_planning_scene", NoRequest, PlanningScene, "The robot and what is around it.", reads=True)
BASE_FRAME = "base_link"
"""Frame of poses in answers."""


class PlanningServices:
    """The services of a planning mode that do not move the robot.

    Args:
        session: the run.
        mode: the mode.
        plans: plans by the mode's planner.

    Attributes:
        handlers: service -> its handler.
    """

    def __init__(self, session: RunView, mode: ControlMode, plans: GoalPlans) -> None:
        self._session = session
        self._robot = session.config.robot
        self._mode = mode
        self._plans = plans
        self.handlers: dict[Service[Any, Any], Callable[[Any], Any]] = {
            COMPUTE_IK: self._ik,
            COMPUTE_FK: self._fk,
            PLAN: self._plan,
            PLAN_GOAL: self._plan_goal,
            CARTESIAN: self._cartesian,
            SCENE: self._scene,
        }

    @cached_property
    def _arm(self) -> Arm:
        find_engines()
        from ibrobot_planning.world.checked_arm import checked_arm

        return checked_arm(self._robot, self._session.log)

    def _plan(self, query: PlanQuery) -> PlanAnswer:
        return self._planned(lambda start: self._plans.any_goal(query.goals, start), query)

    def _plan_goal(self, query: PlanAhead) -> PlanAnswer:
        def planned() -> PlanResult:
            aim = target(query.goal, self._robot)
            self._plans.check(aim)
            plan = self._plans.plan(aim, self._start(query.start))[1]
            if plan is None:
                raise invalid_goal(f"goal {aim.text!r} needs no plan")
            return plan

        return _answer(planned)

    def _cartesian(self, query: CartesianQuery) -> PlanAnswer:
        def goal(start: Vector) -> Goal:
            place = self._plans.surroundings(query.waypoints, start)
            return line_goal(query.waypoints, query.least_fraction, query.path_constraints, *place)

        return self._planned(goal, query)

    def _planned(self, goal: Callable[[Vector], Goal], query: PlanQuery | CartesianQuery) -> PlanAnswer:
        def planned() -> PlanResult:
            joints, whole = arm_joints(self._session.config, self._mode), self._start(query.start)
            others = dict(zip(self._robot.joint_names, whole.tolist(), strict=True))
            first, scalings = whole[self._robot.indices(joints)], (query.velocity_scaling, query.acceleration_scaling)
            return self._plans.planned(PlanRequest(joints, first, goal(whole), *scalings, others))

        return _answer(planned)

    def _start(self, positions: Mapping[str, float]) -> Vector:
        """Positions of all joints [rad], shape (J,); joints that are not named are at their present positions."""
        start = commanded(self._session).copy()
        for name, value in positions.items():
            if name not in self._robot.joint_names:
                raise PlanningError(
                    f"start: no joint {name!r}; the joints are: {', '.join(self._robot.joint_names)}",
                    PlanCode.INVALID_ROBOT_STATE,
                )
            if not np.isfinite(value):
                raise PlanningError(f"start of joint {name} is {value}, must be finite", PlanCode.INVALID_ROBOT_STATE)
            start[self._robot.joint_names.index(name)] = value
        return np.asarray(start)

    def _ik(self, query: IkQuery) -> IkAnswer:
        try:
            start = self._start(query.start)
            goal = query.goal.tool_goal(*self._plans.surroundings((query.goal,), start))
            tool = self._plans.tool
            candidates = tool.candidates(goal, start)
            if (given := query.goal.path_constraints) is not None:
                candidates = tool.kept(goal, candidates, ToolConstraints(given, tool.model, start), start)
            if query.avoid_collisions:
                candidates = self._free(candidates)
        except PlanningError as error:
            return IkAnswer(error.code, str(error))
        best = candidates[0]
        state = JointState(Header(self._session.clock.now_ns()), self._robot.joint_names, best.joints)
        return IkAnswer(PlanCode.SUCCESS, "", state, best.position_error, best.orientation_error)

    def _free(self, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates without contacts.

        Raises:
            PlanningError: if all of them touch something.
        """
        from ibrobot_planning.world.collision import Collisions

        planner, world, padding, self_padding = self._mode.planner, world_of(self._session.bus), 0.0, 0.0
        if planner is not None and isinstance(planner.options, RrtConnectOptions):
            padding, self_padding = planner.options.padding, planner.options.self_padding
        joints = self._robot.joint_names
        checks = Collisions(self._arm, world, joints, padding=padding, self_padding=self_padding)
        free = [each for each in candidates if checks.free(each.joints)]
        if not free:
            contacts = checks.contacts(candidates[0].joints)
            raise PlanningError(
                f"each of its configurations touches something: {'; '.join(map(str, contacts[:3]))}",
                PlanCode.NO_IK_SOLUTION,
            )
        return free

    def _fk(self, query: FkQuery) -> FkAnswer:
        try:
            q = self._start(query.joints) if query.joints else self._session.measured().position
            header = Header(self._session.clock.now_ns(), BASE_FRAME)
            links = query.links or (self._plans.tool.model.tip,)
            return FkAnswer(PlanCode.SUCCESS, "", tuple(PoseStamped(header, self._pose(link, q)) for link in links))
        except PlanningError as error:
            return FkAnswer(error.code, str(error))

    def _pose(self, link: str, q: Vector) -> Any:
        from ibrobot_kinematics.poses import homogeneous, pose

        if link == self._plans.tool.model.tip:
            tip = self._plans.tool.model.forward(q)
            return pose(homogeneous(tip.rotation, tip.position))
        return pose(self._arm.link_pose(self._arm.urdf_links.get(link, link), q))

    def _scene(self, request: NoRequest) -> PlanningScene:
        from ibrobot_planning.world.arm import robot_arm

        robot, reading = self._robot, self._session.measured()
        observed = observed_world(self._session.bus)
        objects = {
            name: ObjectSummary(type(each.shape).__name__.lower(), each.pose, each.link, tuple(sorted(each.may_touch)))
            for name, each in observed.world.objects.items()
        }
        try:
            tip, links = self._plans.tool.model.tip, tuple(robot_arm(robot).frames)
        except IbrobotError:  # a robot without a model can still move its joints
            tip, links = "", ()
        state = JointState(Header(reading.stamp_ns), robot.joint_names, reading.position, reading.velocity)
        return PlanningScene(
            robot.name, state, robot.groups, tuple(robot.description.poses), tip, links, objects, observed.ages
        )


def _answer(plan: Callable[[], PlanResult]) -> PlanAnswer:
    """The answer of a service that plans."""
    begun = time.monotonic()
    try:
        planned = plan()
    except PlanningError as error:
        return PlanAnswer(error.code, str(error), planning_time_s=time.monotonic() - begun)
    trajectory = attrs.evolve(planned.trajectory, header=attrs.evolve(planned.trajectory.header, stamp_ns=0))
    return PlanAnswer(
        PlanCode.SUCCESS, "", trajectory, planned.fraction, planned.alternative,
        planned.position_error, planned.orientation_error, time.monotonic() - begun,
    )  # fmt: skip
