"""The joint-space planner: a straight line from rest to rest, in the least time within the limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import override

import numpy as np

from ibrobot_core.api import (
    Context,
    Header,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanCode,
    PlanningError,
    ns,
    seconds,
)
from ibrobot_planning.goals.grammar import without_names
from ibrobot_planning.planner import JointGoal, Planner, PlanRequest, PlanResult, checked_start, joint_target
from ibrobot_planning.planners.options import JointPlannerOptions
from ibrobot_planning.planners.timing import check_duration

_SHORTEST_PHASE_S = 1e-5
"""Shorter phases of the profile get no point: interpolation would divide by their time."""
_AT_GOAL = 1e-9
"""Smaller distances [rad] count as none."""


class JointPlanner(Planner):
    """Plans in joint space within limits, but ignores obstacles.

    All joints move along one straight line, so the motion has one degree of freedom, the way along that line; the joint
    with the tightest limit sets its pace.
    """

    def __init__(self, options: JointPlannerOptions, ctx: Context) -> None:
        self._options = options
        self._robot = ctx.robot
        self._clock = ctx.clock
        self._period_ns = ctx.period_ns

    @override
    def plan(self, request: PlanRequest) -> PlanResult:
        # A start outside the limits is allowed: an arm at rest may sag beyond them, and must be able to return.
        start, order = checked_start(request, self._robot), self._robot.indices(request.joints)
        goal = without_names(request.goal, self._robot, request.joints)
        if not isinstance(goal, JointGoal):
            raise PlanningError(
                "planner type 'joint' knows joint goals only, not poses of the tool, nor path constraints: "
                "name a pose of robot.description.poses, or use another type of planner, one for Cartesian goals",
                PlanCode.UNRECOGNIZED_GOAL_TYPE,
            )
        delta = joint_target(goal, self._robot, request.joints, start) - start
        velocity = self._options.velocity_scaling * request.velocity_scaling * self._robot.max_velocity[order]
        acceleration = (
            self._options.acceleration_scaling * request.acceleration_scaling * self._robot.max_acceleration[order]
        )
        header = Header(stamp_ns=self._clock.now_ns())
        distance = float(np.max(np.abs(delta), initial=0.0))
        if distance < _AT_GOAL:
            rest = np.zeros(len(start))
            # Two points: the last one must be after time 0.
            stay = tuple(JointTrajectoryPoint(stamp, start, rest, rest) for stamp in (0, self._period_ns))
            return PlanResult(JointTrajectory(header, request.joints, stay))
        # Limits along the line, in terms of the joint that moves farthest: the others move by a fraction of its way.
        share = np.abs(delta) / distance
        moving = share > _AT_GOAL
        fastest, strongest = (float((limits[moving] / share[moving]).min()) for limits in (velocity, acceleration))
        profile = RestToRest(distance, fastest, strongest, self._options.max_jerk)
        check_duration(profile.ends[-1])
        direction = delta / distance
        points = tuple(
            JointTrajectoryPoint(stamp, start + way * direction, speed * direction, rate * direction)
            for stamp, way, speed, rate in _points(profile, self._options.step)
        )
        return PlanResult(JointTrajectory(header, request.joints, points))


class RestToRest:
    """A symmetric profile of seven phases, each of constant jerk; some have no length.

    Speed rises over three phases (jerk `+j`, 0, `-j`), stays constant, and falls symmetrically. Over a short
    distance, velocity and acceleration may not reach their limits.

    Args:
        distance: way from rest to rest, above 0.
        max_velocity: greatest speed, above 0.
        max_acceleration: greatest rate of change of speed, above 0.
        max_jerk: greatest rate of change of acceleration, above 0.

    Attributes:
        ends: when each phase ends [s], 7 times.
    """

    def __init__(self, distance: float, max_velocity: float, max_acceleration: float, max_jerk: float) -> None:
        self.distance = distance
        speed = min(max_velocity, _peak_speed(distance, max_acceleration, max_jerk))
        # The acceleration is a trapezium over time, or a triangle if the speed is reached before its limit.
        ramp = min(max_acceleration / max_jerk, math.sqrt(speed / max_jerk))
        plateau = max(speed / (max_jerk * ramp) - ramp, 0.0)
        cruise = max(distance / speed - 2 * ramp - plateau, 0.0)
        self.ends = tuple(accumulate([ramp, plateau, ramp, cruise, ramp, plateau, ramp]))
        self._times = (ramp, plateau, ramp, 0.5 * cruise)
        self._jerks = (max_jerk, 0.0, -max_jerk, 0.0)

    def at(self, time: float) -> tuple[float, float, float]:
        """Way, speed and acceleration at `time` [s], from 0 to the last of `ends`."""
        if 2 * time > self.ends[-1]:
            way, speed, acceleration = self.at(self.ends[-1] - time)
            return self.distance - way, speed, -acceleration
        way = speed = acceleration = 0.0
        for length, jerk in zip(self._times, self._jerks, strict=True):
            t = min(length, time)
            way += t * (speed + t * (acceleration / 2 + t * jerk / 6))
            speed += t * (acceleration + t * jerk / 2)
            acceleration += t * jerk
            time -= t
        return way, speed, acceleration


def _peak_speed(distance: float, max_acceleration: float, max_jerk: float) -> float:
    """The peak speed without a velocity limit."""
    ramp = max_acceleration / max_jerk
    if distance <= 2 * max_acceleration * ramp**2:  # braking begins before the acceleration reaches its limit
        return math.cbrt(distance**2 * max_jerk / 4)
    # From distance = speed * (speed / max_acceleration + ramp).
    return max_acceleration * (math.sqrt(ramp**2 / 4 + distance / max_acceleration) - ramp / 2)


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
