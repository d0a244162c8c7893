"""The joint-space planner: a straight line from rest to rest, in the least time that the limits allow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import override

import numpy as np

from ibrobot_core.api import (
    Context,
    Header,
    Joint,
    JointGoal,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanCode,
    Planner,
    PlanningError,
    PlanRequest,
    PlanResult,
    Vector,
    ns,
    seconds,
)
from ibrobot_planning.goals.text import scaling_fault
from ibrobot_planning.planners.options import JointPlannerOptions
from ibrobot_planning.planners.profile import RestToRest
from ibrobot_planning.planners.timing import check_duration

_SHORTEST_PHASE_S = 1e-5
"""Shorter phases of the profile get no point of their own: interpolation would divide by their time."""
_AT_GOAL = 1e-9
"""Greatest distance [rad] that counts as none."""


class JointPlanner(Planner):
    """Plans in joint space within limits, but ignores obstacles.

    All joints move along one straight line, so the motion has one degree of freedom, the way along that line; the joint
    with the tightest limit sets its pace.
    """

    def __init__(self, options: JointPlannerOptions, ctx: Context) -> None:
        self._options = options
        self._joints = {joint.name: joint for joint in ctx.robot.joints}
        self._clock = ctx.clock
        self._period_ns = ctx.period_ns

    @override
    def plan(self, request: PlanRequest) -> PlanResult:
        joints = self._check_start(request)
        delta = self._goal(request, joints) - request.start
        velocity = self._options.velocity_scaling * _fraction("velocity_scaling", request.velocity_scaling)
        acceleration = self._options.acceleration_scaling * _fraction(
            "acceleration_scaling", request.acceleration_scaling
        )
        header = Header(stamp_ns=self._clock.now_ns())
        distance = float(np.max(np.abs(delta), initial=0.0))
        if distance < _AT_GOAL:
            rest = np.zeros(len(joints))
            # Two points, since an executor needs time to arrive.
            stay = tuple(JointTrajectoryPoint(stamp, request.start, rest, rest) for stamp in (0, self._period_ns))
            return PlanResult(JointTrajectory(header, request.joints, stay))
        # Limits along the line, measured on the joint that moves farthest: the others move by a fraction of its way.
        share = np.abs(delta) / distance
        moving = share > _AT_GOAL

        def along(values: list[float]) -> float:
            return float(np.min(np.array(values)[moving] / share[moving]))

        profile = RestToRest(
            distance,
            along([joint.max_velocity * velocity for joint in joints]),
            along([joint.max_acceleration * acceleration for joint in joints]),
            self._options.max_jerk,
        )
        check_duration(profile.ends[-1])
        direction = delta / distance
        points = tuple(
            JointTrajectoryPoint(stamp, request.start + way * direction, speed * direction, rate * direction)
            for stamp, way, speed, rate in _points(profile, self._options.step)
        )
        return PlanResult(JointTrajectory(header, request.joints, points))

    def _check_start(self, request: PlanRequest) -> list[Joint]:
        """The joints of the request, after a check of the request."""
        joints = [self._joint(name) for name in request.joints]
        if np.shape(request.start) != (len(joints),):
            raise PlanningError(f"start has shape {np.shape(request.start)}, must be ({len(joints)},): one per joint")
        # A start outside the limits is allowed: an arm at rest may sag beyond them, and must be able to return.
        for joint, value in zip(joints, request.start, strict=True):
            if not math.isfinite(value):
                raise PlanningError(f"start of joint {joint.name} is {value}, must be finite")
        return joints

    def _goal(self, request: PlanRequest, joints: list[Joint]) -> Vector:
        """Goal position of every joint of the request [rad], shape (J,)."""
        goal = request.goal
        if not isinstance(goal, JointGoal):
            raise PlanningError(
                "planner type 'joint' knows joint goals only, not poses of the tool: "
                "name a pose of robot.description.poses, or use another type of planner, one for Cartesian goals",
                PlanCode.UNRECOGNIZED_GOAL_TYPE,
            )
        self._check_goal(goal)
        target = np.array(request.start, dtype=float)
        for name, value in zip(goal.joints, goal.positions, strict=True):
            if name not in request.joints:
                raise PlanningError(f"goal names joint {name!r}, which is not planned: {', '.join(request.joints)}")
            target[request.joints.index(name)] = value
        return target

    def _check_goal(self, goal: JointGoal) -> None:
        if np.shape(goal.positions) != (len(goal.joints),):
            raise PlanningError(f"goal has {len(goal.joints)} joints but positions of shape {np.shape(goal.positions)}")
        for i, (name, value) in enumerate(zip(goal.joints, goal.positions, strict=True)):
            joint = self._joint(name)
            if name in goal.joints[:i]:
                raise PlanningError(f"goal names joint {name!r} twice")
            # Written so that NaN fails it.
            if not joint.lower <= value <= joint.upper:
                raise PlanningError(
                    f"goal of joint {name} is {value} rad, must be within {joint.lower} .. {joint.upper} rad"
                )

    def _joint(self, name: str) -> Joint:
        if name not in self._joints:
            raise PlanningError(f"no joint {name!r}; the joints are: {', '.join(self._joints)}")
        return self._joints[name]


def _fraction(name: str, value: float) -> float:
    if fault := scaling_fault(name, value):
        raise PlanningError(fault)
    return value


def _points(profile: RestToRest, step: float) -> list[tuple[int, float, float, float]]:
    """Points on a profile, at most `step` [s] apart.

    Every phase begins and ends on a point: an executor that interpolates with positions, velocities and accelerations
    follows the profile exactly.

    Returns:
        Per point: time [ns], way, speed and its rate of change.
    """
    stamps = _stamps(profile.ends, step)
    between = [(stamp, *profile.at(seconds(stamp))) for stamp in stamps[:-1]]
    return [(0, 0.0, 0.0, 0.0), *between, (max(stamps[-1], 1), profile.distance, 0.0, 0.0)]


def _stamps(ends: Sequence[float], step: float) -> list[int]:
    """Times [ns] that cut each phase, ending at `ends` [s], into equal parts of at most `step` [s]; zero left out."""
    stamps: list[int] = []
    begin = 0.0
    for end in ends:
        if end - begin < _SHORTEST_PHASE_S:
            continue
        parts = math.ceil((end - begin) / step)
        stamps += [ns(time) for time in np.linspace(begin, end, parts + 1)[1:]]
        begin = end
    return stamps or [ns(ends[-1])]
