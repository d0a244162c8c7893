"""The conformance suite of executors."""

from __future__ import annotations

import math
from typing import ClassVar, override

import attrs
import numpy as np
import pytest

from ibrobot_core.api import (
    Context,
    Executor,
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    GoalState,
    GoalStatus,
    Header,
    JointReading,
    JointTrajectory,
    MoveJoint,
    Plan,
    Vector,
    ns,
    seconds,
)
from ibrobot_testing.contexts import ARM, control_context
from ibrobot_testing.suite import Suite


class ExecutorSuite(Suite[Executor]):
    """Checks of every `Executor`. If it accepts goals, the subclass defines `goal` and `wrong_goals`."""

    tolerance_rad: ClassVar[float] = 1e-6
    """Allowed distance of a held setpoint from the position to hold [rad]."""
    goal_ticks: ClassVar[int] = 2000
    """Maximum number of ticks for a goal."""
    stale_s: ClassVar[float] = 60.0
    """Time after the end of a plan at which it is stale, whatever the options [s]."""

    @override
    def context(self) -> Context:
        return control_context(joints=ARM)

    def goal(self, ctx: Context, position: Vector) -> ExecutorGoal | None:
        """A goal that ends at `position` [rad], shape (J,); None for executors that do not accept goals."""
        return None

    def wrong_goals(self, ctx: Context) -> list[ExecutorGoal]:
        """Goals that must be refused."""
        return [MoveJoint(math.nan), FollowTrajectory(JointTrajectory(Header(), ("nonsense",), ()))]

    def poses(self, ctx: Context) -> list[Vector]:
        """Positions [rad], each shape (J,): nonzero and within limits."""
        order = ctx.robot.indices(ctx.joints)
        lower, upper = ctx.robot.lower[order], ctx.robot.upper[order]
        return [lower + share * (upper - lower) for share in (0.3, 0.35, 0.65)]

    def active(self) -> tuple[Executor, Context, Vector]:
        """An executor activated at the first of `poses`, with its context and that position."""
        ctx = self.context()
        executor = self.make(ctx)
        start = self.poses(ctx)[0]
        executor.activate(measure(ctx, start))
        return executor, ctx, start

    def _goal(self, ctx: Context, position: Vector) -> ExecutorGoal:
        goal = self.goal(ctx, position)
        if goal is None:
            pytest.skip("takes no goals")
        return goal

    def _follow(self, executor: Executor, ctx: Context, position: Vector, ticks: int) -> list[Vector]:
        """Setpoints of `ticks` ticks, from `position`, with joints that follow immediately."""
        setpoints = []
        for _ in range(ticks):
            position = executor.update(tick(ctx, position)).copy()
            setpoints.append(position)
        return setpoints

    def test_owns_the_joints_it_was_given(self) -> None:
        """`joints` is set by the constructor and equals `ctx.joints`."""
        ctx = self.context()
        assert self.make(ctx).joints == ctx.joints

    def test_activation_holds_the_measured_position(self) -> None:
        """From the first tick, the setpoint is the initial position and does not follow the joints when they sag."""
        ctx = self.context()
        executor = self.make(ctx)
        for pose in self.poses(ctx):
            executor.activate(measure(ctx, pose))
            for sag in (0.0, 0.01, 0.02, 0.03):
                setpoint = executor.update(tick(ctx, pose - sag))
                np.testing.assert_allclose(setpoint, pose, atol=self.tolerance_rad)
            executor.deactivate()

    def test_activation_wants_torque(self) -> None:
        """`wants_relax` is False after activation, even if it was True before."""
        executor, ctx, start = self.active()
        assert executor.wants_relax is False
        if executor.accepts_plans:
            executor.set_plan(plan_towards(ctx, start, self.poses(ctx)[1]))
        for _ in range(200):
            executor.update(tick(ctx, start))
        executor.deactivate()
        executor.activate(measure(ctx, start))
        assert executor.wants_relax is False

    def test_setpoints_are_complete(self) -> None:
        """Every setpoint has a finite value for each joint."""
        executor, ctx, start = self.active()
        for noise in np.random.default_rng(0).normal(0, 0.02, (20, len(start))):
            setpoint = executor.update(tick(ctx, start + noise))
            assert setpoint.shape == (len(ctx.joints),)
            assert setpoint.dtype == np.float64
            assert np.isfinite(setpoint).all()

    def test_keeps_no_hold_of_the_callers_arrays(self) -> None:
        """The executor keeps no reference to the caller's arrays, and does not change them."""
        executor, ctx, start = self.active()
        reading = measure(ctx, start)
        executor.activate(reading)
        np.testing.assert_array_equal(reading.position, start)
        reading.position[:] = 0.0
        first = executor.update(tick(ctx, start))
        np.testing.assert_allclose(first, start, atol=self.tolerance_rad)
        first[:] = 0.0
        np.testing.assert_allclose(executor.update(tick(ctx, start)), start, atol=self.tolerance_rad)

    def test_deactivation_forgets(self) -> None:
        """`deactivate` discards plan and goal: the next activation holds."""
        executor, ctx, start = self.active()
        target, elsewhere = self.poses(ctx)[1:]
        if executor.accepts_plans:
            executor.set_plan(plan_towards(ctx, start, target))
        elif (goal := self.goal(ctx, target)) is not None:
            executor.set_goal("old", goal, measure(ctx, start))
        self._follow(executor, ctx, start, 3)
        executor.deactivate()
        executor.deactivate()
        executor.activate(measure(ctx, elsewhere))
        for setpoint in self._follow(executor, ctx, elsewhere, 20):
            np.testing.assert_allclose(setpoint, elsewhere, atol=self.tolerance_rad)

    def test_follows_a_plan_by_time(self) -> None:
        """The setpoint at the time of a plan's point is that point."""
        executor, ctx, start = self.active()
        plan = plan_towards(ctx, start, self.poses(ctx)[1])
        if not executor.accepts_plans:
            with pytest.raises(NotImplementedError):
                executor.set_plan(plan)
            return
        executor.set_plan(plan)
        position = start
        for i, point in enumerate(plan.positions):
            ctx.clock.sleep_until(plan.start_ns + i * plan.step_ns)
            position = executor.update(measure(ctx, position)).copy()
            meets = "a plan's points are met in time, also where they are fast: limits are the safety layer's"
            np.testing.assert_allclose(position, point, atol=self.tolerance_rad, err_msg=f"point {i}: {meets}")

    def test_a_plan_that_ended_long_ago_is_stale(self) -> None:
        """`is_stale` or `wants_relax` says so, until the next plan or activation: the loop lets the joints brake."""
        executor, ctx, start = self.active()
        if not executor.accepts_plans:
            pytest.skip("accepts no plans")
        plan = plan_towards(ctx, start, self.poses(ctx)[1])
        executor.set_plan(plan)
        executor.update(tick(ctx, start))
        assert (executor.is_stale, executor.wants_relax) == (False, False)
        ctx.clock.sleep_until(plan.start_ns + len(plan.positions) * plan.step_ns + ns(self.stale_s))
        executor.update(tick(ctx, start))
        assert executor.is_stale or executor.wants_relax, f"a plan that ended {self.stale_s:g} s ago is still followed"
        executor.activate(measure(ctx, start))
        assert (executor.is_stale, executor.wants_relax) == (False, False)

    def test_refuses_an_impossible_plan(self) -> None:
        """A plan with NaN or a wrong width is counted, from 0, and the old setpoint remains."""
        executor, ctx, start = self.active()
        if not executor.accepts_plans:
            pytest.skip("accepts no plans")
        assert not any(executor.counters().values()), "a counter does not begin at 0"
        whole = plan_towards(ctx, start, self.poses(ctx)[1])
        with_nan = whole.positions.copy()
        with_nan[1, 0] = np.nan
        for wrong in (with_nan, whole.positions[:, 1:], np.hstack([whole.positions, whole.positions])):
            before = sum(executor.counters().values())
            executor.set_plan(attrs.evolve(whole, positions=wrong))
            np.testing.assert_allclose(executor.update(tick(ctx, start)), start, atol=self.tolerance_rad)
            assert sum(executor.counters().values()) > before, "a refused plan must be counted"

    def test_reaches_its_goal(self) -> None:
        """A goal that the joints can follow succeeds, with the setpoint at the goal."""
        executor, ctx, start = self.active()
        target = self.poses(ctx)[1]
        executor.set_goal("one", self._goal(ctx, target), measure(ctx, start))
        position = start
        statuses: list[GoalStatus] = []
        for _ in range(self.goal_ticks):
            position = executor.update(tick(ctx, position)).copy()
            statuses += drain(executor)
            if statuses and statuses[-1].state is not GoalState.EXECUTING:
                break
        assert statuses, f"no status within {self.goal_ticks} ticks"
        assert {each.goal_id for each in statuses} == {"one"}, "a status names no goal, or another one"
        assert statuses[-1].state == GoalState.SUCCEEDED, statuses[-1]
        np.testing.assert_allclose(position, target, atol=0.05)

    def test_a_rejected_goal_leaves_the_old_one(self) -> None:
        """A wrong goal raises GoalRejected, and the present goal continues unchanged, bit by bit."""
        executor, ctx, start = self.active()
        twin = self.make(ctx)
        twin.activate(measure(ctx, start))
        goal = self.goal(ctx, self.poses(ctx)[1])
        if goal is not None:
            for one in (executor, twin):
                one.set_goal("old", goal, measure(ctx, start))
        position = start
        for wrong in self.wrong_goals(ctx):
            reading = tick(ctx, position)
            with pytest.raises(GoalRejected):
                executor.set_goal("wrong", wrong, reading)
            position = executor.update(reading).copy()
            np.testing.assert_array_equal(position, twin.update(reading))
        assert drain(executor) == drain(twin), "a goal that was rejected has no state"

    def test_replacing_a_goal_makes_no_step(self) -> None:
        """A new goal begins where the setpoint is, whether it goes on or back."""
        executor, ctx, start = self.active()
        near, far = self.poses(ctx)[1:]
        executor.set_goal("old", self._goal(ctx, near), measure(ctx, start))
        before = self._follow(executor, ctx, start, 5)[-1]
        reach = ctx.robot.max_velocity[ctx.robot.indices(ctx.joints)] * seconds(ctx.period_ns)
        for name, target in (("new", far), ("back", start)):
            executor.set_goal(name, self._goal(ctx, target), measure(ctx, before))
            after = self._follow(executor, ctx, before, 1)[0]
            for joint, step, most in zip(ctx.joints, np.abs(after - before), reach, strict=True):
                assert step <= most + self.tolerance_rad, (
                    f"{joint}: a step of {step:.4f} rad in a tick, where max_velocity allows {most:.4f}: a new goal "
                    "begins where the setpoint is"
                )
            before = after

    def test_cancel_holds_the_measured_position(self) -> None:
        """After `cancel` the setpoint is the measured position, and the goal is reported as canceled."""
        executor, ctx, start = self.active()
        executor.set_goal("one", self._goal(ctx, self.poses(ctx)[1]), measure(ctx, start))
        position = self._follow(executor, ctx, start, 5)[-1] - 0.01
        ended = [each.state for each in drain(executor) if each.state is not GoalState.EXECUTING]
        assert not ended, f"the goal has {ended[0]} within 5 ticks: override `poses`, with the second farther away"
        executor.cancel(tick(ctx, position))
        for _ in range(5):
            np.testing.assert_allclose(executor.update(tick(ctx, position)), position, atol=self.tolerance_rad)
        last = drain(executor)[-1]
        assert (last.goal_id, last.state) == ("one", GoalState.CANCELED)

    def test_cancel_without_a_goal_does_nothing_bad(self) -> None:
        """`cancel` with no goal holds, and reports nothing."""
        executor, ctx, start = self.active()
        executor.cancel(tick(ctx, start))
        np.testing.assert_allclose(executor.update(tick(ctx, start)), start, atol=self.tolerance_rad)
        assert drain(executor) == []


def measure(ctx: Context, position: Vector) -> JointReading:
    """Joints at rest at `position` [rad], shape (J,), now."""
    zero = np.zeros_like(position)
    return JointReading(ctx.clock.now_ns(), position.copy(), zero, zero.copy())


def tick(ctx: Context, position: Vector) -> JointReading:
    """Joints at rest at `position` [rad], shape (J,), one control period later."""
    ctx.clock.sleep_until(ctx.clock.now_ns() + ctx.period_ns)
    return measure(ctx, position)


def plan_towards(ctx: Context, start: Vector, target: Vector) -> Plan:
    """A plan of ten slow points from `start` towards `target`, which begins in two ticks."""
    shares = np.linspace(0.0, 0.2, 10)[:, None]
    positions = start + shares * (target - start)
    return Plan(ctx.clock.now_ns() + 2 * ctx.period_ns, 3 * ctx.period_ns, positions)


def drain(executor: Executor) -> list[GoalStatus]:
    """Every status not yet reported."""
    return list(iter(executor.pop_status, None))
