"""The executor suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_testing import ExecutorSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeExecutor, FakeTrajectoryExecutor

from ibrobot_core.api import (
    FollowTrajectory,
    GoalRejected,
    GoalState,
    GoalStatus,
    Header,
    JointTrajectory,
    JointTrajectoryPoint,
)


def trajectory(joints, position):
    point = JointTrajectoryPoint(2_000_000_000, position)
    return FollowTrajectory(JointTrajectory(Header(), joints, (point,)))


class TestExecutor(ExecutorSuite):
    @override
    def make(self, ctx):
        return FakeExecutor(ctx)

    @override
    def goal(self, ctx, position):
        return trajectory(ctx.joints, position)

    @override
    def wrong_goals(self, ctx):
        return [trajectory(ctx.joints, [0.0]), trajectory(ctx.joints, [float("nan")] * len(ctx.joints))]


class TestTrajectoryExecutor(ExecutorSuite):
    @override
    def make(self, ctx):
        return FakeTrajectoryExecutor(ctx)

    @override
    def goal(self, ctx, position):
        return trajectory(ctx.joints, position)


class OtherJoints(FakeExecutor):
    def __init__(self, ctx):
        super().__init__(ctx)
        self.joints = ctx.joints[1:]


class HoldsZero(FakeExecutor):
    def activate(self, measured):
        self._setpoint = np.zeros_like(measured.position)


class FollowsTheSag(FakeExecutor):
    def update(self, measured):
        if self._plan is None and self._goal_id is None:
            self._setpoint = measured.position.copy()
        return super().update(measured)


class StaysRelaxed(FakeExecutor):
    """Once relaxed for want of setpoints, it stays so."""

    _updates = 0

    @property
    def wants_relax(self):
        return self._updates > 100

    def update(self, measured):
        self._updates += 1
        return super().update(measured)


class NotANumber(FakeExecutor):
    def update(self, measured):
        return super().update(measured) * np.nan


class WholeRobot(FakeExecutor):
    def update(self, measured):
        return np.append(super().update(measured), 0.0)


class KeepsTheReading(FakeExecutor):
    def activate(self, measured):
        self._setpoint = measured.position


class GivesItsOwnArray(FakeExecutor):
    def update(self, measured):
        super().update(measured)
        return self._setpoint


class RemembersItsWork(FakeExecutor):
    def deactivate(self):
        if not hasattr(self, "_plan"):
            super().deactivate()


class IgnoresTime(FakeExecutor):
    def update(self, measured):
        if self._plan is not None:
            self._setpoint = self._plan.positions[-1].copy()
        return super().update(measured) if self._plan is None else self._setpoint.copy()


class FollowsForEver(FakeExecutor):
    is_stale = False


class SwallowsRefusals(FakeExecutor):
    def counters(self):
        return {}


class PlaysNaN(FakeExecutor):
    def set_plan(self, plan):
        if plan.positions.shape[1:] == self._setpoint.shape:
            self._plan = plan


class StopsShort(FakeExecutor):
    def _end_goal(self, state):
        super()._end_goal(state)
        self._setpoint = self._setpoint - 0.2


class NeverReports(FakeExecutor):
    def pop_status(self):
        return None


class DropsTheOldGoal(FakeExecutor):
    def set_goal(self, goal_id, goal, measured):
        try:
            super().set_goal(goal_id, goal, measured)
        except GoalRejected:
            self._goal_id = None
            raise


class AcceptsAnything(FakeExecutor):
    def set_goal(self, goal_id, goal, measured):
        try:
            super().set_goal(goal_id, goal, measured)
        except GoalRejected:
            self._statuses.append(GoalStatus(goal_id, GoalState.ABORTED))


class JumpsToANewGoal(FakeExecutor):
    def set_goal(self, goal_id, goal, measured):
        if self._goal_id is not None:
            self._setpoint = self._goal
        super().set_goal(goal_id, goal, measured)


class CancelGoesOn(FakeExecutor):
    def cancel(self, measured):
        if self._goal_id is not None:
            self._statuses.append(GoalStatus(self._goal_id, GoalState.CANCELED))


class CancelsNothing(FakeExecutor):
    def cancel(self, measured):
        super().cancel(measured)
        self._statuses.append(GoalStatus("", GoalState.CANCELED))


class ReportsNoGoal(FakeExecutor):
    def pop_status(self):
        status = super().pop_status()
        if status is not None and status.state is GoalState.EXECUTING:
            return attrs.evolve(status, goal_id="")
        return status


class JumpsBack(FakeExecutor):
    """Limits its speed in one direction alone."""

    def update(self, measured):
        before = self._setpoint
        if self._goal_id is not None and (self._goal < before).any():
            self._setpoint = self._goal
        return super().update(measured)


class CountsFromOne(FakeExecutor):
    def counters(self):
        return {"refused_plans": super().counters()["refused_plans"] + 1}


WRONG = {
    OtherJoints: "owns_the_joints_it_was_given",
    HoldsZero: "activation_holds_the_measured_position",
    FollowsTheSag: "activation_holds_the_measured_position",
    StaysRelaxed: "activation_wants_torque",
    NotANumber: "setpoints_are_complete",
    WholeRobot: "setpoints_are_complete",
    KeepsTheReading: "keeps_no_hold_of_the_callers_arrays",
    GivesItsOwnArray: "keeps_no_hold_of_the_callers_arrays",
    RemembersItsWork: "deactivation_forgets",
    IgnoresTime: "follows_a_plan_by_time",
    FollowsForEver: "a_plan_that_ended_long_ago_is_stale",
    SwallowsRefusals: "refuses_an_impossible_plan",
    PlaysNaN: "refuses_an_impossible_plan",
    StopsShort: "reaches_its_goal",
    NeverReports: "reaches_its_goal",
    DropsTheOldGoal: "a_rejected_goal_leaves_the_old_one",
    AcceptsAnything: "a_rejected_goal_leaves_the_old_one",
    ReportsNoGoal: "reaches_its_goal",
    JumpsBack: "replacing_a_goal_makes_no_step",
    CountsFromOne: "refuses_an_impossible_plan",
    JumpsToANewGoal: "replacing_a_goal_makes_no_step",
    CancelGoesOn: "cancel_holds_the_measured_position",
    CancelsNothing: "cancel_without_a_goal_does_nothing_bad",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestExecutor):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_goal_that_ends_too_soon_to_cancel_says_what_to_override():
    class Near(TestExecutor):
        @override
        def poses(self, ctx):
            return [pose + np.full(len(ctx.joints), 0.001) for pose in super().poses(ctx)[:1]] * 2

    with pytest.raises(AssertionError, match="the goal has succeeded within 5 ticks: override `poses`"):
        Near().test_cancel_holds_the_measured_position()


def test_every_check_catches_something():
    assert checks(ExecutorSuite) == set(WRONG.values())
