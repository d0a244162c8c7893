"""The planner suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_planning.planner import ConstrainedGoal, JointGoal, PlanResult
from ibrobot_planning.suite import FakePlanner, PlannerSuite
from ibrobot_testing import checks, failed_checks

from ibrobot_core.api import PlanningError


class TestPlanner(PlannerSuite):
    @override
    def make(self, ctx):
        return FakePlanner(ctx)


class StopsShort(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        return PlanResult(attrs.evolve(trajectory, points=trajectory.points[:-1]))


class BeginsLate(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        later = (attrs.evolve(p, time_from_start_ns=p.time_from_start_ns + 10**9) for p in trajectory.points)
        return PlanResult(attrs.evolve(trajectory, points=tuple(later)))


class RobotOrder(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        return PlanResult(attrs.evolve(trajectory, joint_names=self._robot.joint_names))


class RunsThroughTheGoal(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        last = attrs.evolve(trajectory.points[-1], velocities=np.full(len(request.joints), 0.5))
        return PlanResult(attrs.evolve(trajectory, points=(*trajectory.points[:-1], last)))


class TwiceAsFast(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        fast = (
            attrs.evolve(p, time_from_start_ns=p.time_from_start_ns // 2, velocities=p.velocities * 2)
            for p in trajectory.points
        )
        return PlanResult(attrs.evolve(trajectory, points=tuple(fast)))


class LeavesTheLimitsOnTheWay(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        middle = len(trajectory.points) // 2
        far = attrs.evolve(trajectory.points[middle], positions=trajectory.points[middle].positions + 10)
        points = (*trajectory.points[:middle], far, *trajectory.points[middle + 1 :])
        return PlanResult(attrs.evolve(trajectory, points=points))


class IgnoresScaling(FakePlanner):
    def plan(self, request):
        return super().plan(attrs.evolve(request, velocity_scaling=1.0, acceleration_scaling=1.0))


class OthersGoToZero(FakePlanner):
    def plan(self, request):
        goal = np.zeros(len(request.joints))
        for joint, position in zip(request.goal.joints, request.goal.positions, strict=True):
            if joint in request.joints:
                goal[request.joints.index(joint)] = position
        return super().plan(attrs.evolve(request, goal=JointGoal(request.joints, goal)))


class NoPointsWithoutAWay(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        way = np.abs(trajectory.points[-1].positions - request.start).max()
        return PlanResult(trajectory if way > 0 else attrs.evolve(trajectory, points=()))


class ClampsTheGoal(FakePlanner):
    def plan(self, request):
        order = self._robot.indices(request.goal.joints)
        inside = np.clip(request.goal.positions, self._robot.lower[order], self._robot.upper[order])
        return super().plan(attrs.evolve(request, goal=attrs.evolve(request.goal, positions=inside)))


class IgnoresUnknownJoints(FakePlanner):
    def plan(self, request):
        known = tuple(joint for joint in request.goal.joints if joint in request.joints)
        return super().plan(attrs.evolve(request, goal=JointGoal(known, request.goal.positions[: len(known)])))


class OverlooksConstraints(FakePlanner):
    def plan(self, request):
        goal = request.goal.goal if isinstance(request.goal, ConstrainedGoal) else request.goal
        return super().plan(attrs.evolve(request, goal=goal))


class ChangesTheRequest(FakePlanner):
    def plan(self, request):
        trajectory = super().plan(request).trajectory
        request.start[:] = 0.0
        return PlanResult(trajectory)


class ClosesOnce(FakePlanner):
    closed = False

    def close(self):
        if self.closed:
            raise PlanningError("closed already")
        self.closed = True


class BlocksItself(FakePlanner):
    def blocked(self, trajectory, others, from_ns=0):
        return "the arm is in its own way"


class NoHeader(FakePlanner):
    def plan(self, request):
        nothing: Any = None
        result = super().plan(request)
        return attrs.evolve(result, trajectory=attrs.evolve(result.trajectory, header=nothing))


WRONG = {
    StopsShort: "goes_from_start_to_goal",
    BeginsLate: "goes_from_start_to_goal",
    NoHeader: "names_the_joints_asked_for",
    RobotOrder: "names_the_joints_asked_for",
    RunsThroughTheGoal: "begins_and_ends_at_rest",
    TwiceAsFast: "keeps_the_limits",
    LeavesTheLimitsOnTheWay: "keeps_the_limits",
    IgnoresScaling: "scaling_slows_down",
    OthersGoToZero: "joints_not_named_stay",
    NoPointsWithoutAWay: "no_way_to_go_is_a_trajectory_too",
    ClampsTheGoal: "refuses_a_goal_outside_the_limits",
    IgnoresUnknownJoints: "refuses_an_impossible_goal",
    OverlooksConstraints: "overlooks_no_path_constraint",
    ChangesTheRequest: "leaves_the_request_alone",
    BlocksItself: "nothing_blocks_its_own_trajectory",
    ClosesOnce: "close_is_safe_twice",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestPlanner):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(PlannerSuite) == set(WRONG.values())
