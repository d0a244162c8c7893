"""The conformance suite of planners, and a planner and a guard for tests; all need `ibrobot-testing`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, ClassVar, override

import attrs
import numpy as np
import pytest
from ibrobot_kinematics import PathConstraints
from ibrobot_testing.suite import Suite

from ibrobot_core.api import (
    Context,
    HardwareError,
    Header,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanCode,
    PlanningError,
    Vector,
    ns,
    seconds,
)
from ibrobot_core.app import Guard
from ibrobot_planning.planner import ConstrainedGoal, JointGoal, Planner, PlanRequest, PlanResult


class PlannerSuite(Suite[Planner]):
    """Checks of every `Planner` with joint goals."""

    tolerance_rad: ClassVar[float] = 1e-6
    """Allowed distance of a trajectory's ends from start and goal [rad]."""
    samples: ClassVar[int] = 20
    """Samples between two points, at which limits are checked."""

    def loaded(self) -> AbstractContextManager[tuple[Planner, Context]]:
        """A loaded planner with its context."""
        return self.in_use(lambda planner: planner.load(), lambda planner: planner.close())

    def request(self, ctx: Context, seed: int, joints: tuple[str, ...] | None = None) -> PlanRequest:
        """A request between random positions within limits; override it if these could collide."""
        joints = ctx.robot.joint_names if joints is None else joints
        order = ctx.robot.indices(joints)
        lower, upper = ctx.robot.lower[order], ctx.robot.upper[order]
        start, goal = np.random.default_rng(seed).uniform(lower, upper, (2, len(joints)))
        return PlanRequest(joints, start, JointGoal(joints, goal))

    def test_goes_from_start_to_goal(self) -> None:
        """The first point is the start at time zero, the last the goal, and times increase."""
        with self.loaded() as (planner, ctx):
            for seed in range(5):
                request = self.request(ctx, seed)
                points = planner.plan(request).trajectory.points
                assert isinstance(request.goal, JointGoal)
                assert points[0].time_from_start_ns == 0
                np.testing.assert_allclose(points[0].positions, request.start, atol=self.tolerance_rad)
                np.testing.assert_allclose(points[-1].positions, request.goal.positions, atol=self.tolerance_rad)
                assert (np.diff([p.time_from_start_ns for p in points]) > 0).all(), "times must increase"

    def test_nothing_blocks_its_own_trajectory(self) -> None:
        """`blocked` finds nothing in the way of a trajectory just planned."""
        with self.loaded() as (planner, ctx):
            trajectory = planner.plan(self.request(ctx, 0)).trajectory
            for from_ns in (0, trajectory.points[-1].time_from_start_ns // 2):
                assert planner.blocked(trajectory, {}, from_ns) == ""

    def test_names_the_joints_asked_for(self) -> None:
        """The trajectory has exactly the request's joints, in its order, and a value for each in every point."""
        with self.loaded() as (planner, ctx):
            for joints in (ctx.robot.joint_names, ctx.robot.joint_names[::-1], ctx.robot.joint_names[1:3]):
                request = self.request(ctx, 1, joints)
                trajectory = planner.plan(request).trajectory
                assert isinstance(trajectory.header, Header), f"the trajectory's header is {trajectory.header!r}"
                assert trajectory.joint_names == joints
                for point in trajectory.points:
                    assert point.positions.shape == (len(joints),)
                    assert np.isfinite(point.positions).all()
                np.testing.assert_allclose(trajectory.points[0].positions, request.start, atol=self.tolerance_rad)

    def test_begins_and_ends_at_rest(self) -> None:
        """Velocities at both ends are zero."""
        with self.loaded() as (planner, ctx):
            points = planner.plan(self.request(ctx, 2)).trajectory.points
            for point in (points[0], points[-1]):
                if point.velocities.size:
                    np.testing.assert_allclose(point.velocities, 0.0, atol=1e-6)

    def test_keeps_the_limits(self) -> None:
        """A trajectory, sampled between its points, stays within the limits of position, velocity and acceleration."""
        with self.loaded() as (planner, ctx):
            for seed in range(5):
                request = self.request(ctx, seed)
                check_limits(planner.plan(request).trajectory, request, ctx, self.samples)

    def test_scaling_slows_down(self) -> None:
        """Scaled limits are observed in the same way."""
        with self.loaded() as (planner, ctx):
            whole = self.request(ctx, 3)
            for velocity, acceleration in ((0.3, 1.0), (1.0, 0.3), (0.1, 0.1)):
                slow = attrs.evolve(whole, velocity_scaling=velocity, acceleration_scaling=acceleration)
                check_limits(planner.plan(slow).trajectory, slow, ctx, self.samples)

    def test_joints_not_named_stay(self) -> None:
        """A goal for one joint moves no other."""
        with self.loaded() as (planner, ctx):
            request = self.request(ctx, 4)
            assert isinstance(request.goal, JointGoal)
            goal = JointGoal(request.joints[1:2], request.goal.positions[1:2])
            for point in planner.plan(attrs.evolve(request, goal=goal)).trajectory.points:
                others = np.delete(point.positions - request.start, 1)
                np.testing.assert_allclose(others, 0.0, atol=self.tolerance_rad)

    def test_no_way_to_go_is_a_trajectory_too(self) -> None:
        """A goal at the present positions gives a trajectory that stays there."""
        with self.loaded() as (planner, ctx):
            request = self.request(ctx, 5)
            stay = attrs.evolve(request, goal=JointGoal(request.joints, request.start))
            points = planner.plan(stay).trajectory.points
            assert points
            for point in points:
                np.testing.assert_allclose(point.positions, request.start, atol=self.tolerance_rad)

    def test_refuses_a_goal_outside_the_limits(self) -> None:
        """Such a goal is a PlanningError that names the joint."""
        with self.loaded() as (planner, ctx):
            request = self.request(ctx, 6)
            assert isinstance(request.goal, JointGoal)
            for i, joint in enumerate(request.joints):
                positions = request.goal.positions.copy()
                positions[i] = ctx.robot.upper[ctx.robot.indices([joint])[0]] + 0.1
                with pytest.raises(PlanningError, match=joint):
                    planner.plan(attrs.evolve(request, goal=JointGoal(request.joints, positions)))

    def test_refuses_an_impossible_goal(self) -> None:
        """A goal that is not finite, or for an unknown joint, is a PlanningError."""
        with self.loaded() as (planner, ctx):
            request = self.request(ctx, 7)
            for goal in (
                JointGoal(request.joints, np.full(len(request.joints), np.nan)),
                JointGoal(("no_such_joint",), np.zeros(1)),
            ):
                with pytest.raises(PlanningError):
                    planner.plan(attrs.evolve(request, goal=goal))

    def test_overlooks_no_path_constraint(self) -> None:
        """A goal with constraints that no robot keeps is a PlanningError, whether the planner knows them or not."""
        with self.loaded() as (planner, ctx):
            request = self.request(ctx, 9)
            assert isinstance(request.goal, JointGoal)
            far = PathConstraints(region=(1e3, 1e3, 1e3, 2e3, 2e3, 2e3))
            with pytest.raises(PlanningError):
                planner.plan(attrs.evolve(request, goal=ConstrainedGoal(request.goal, far)))

    def test_leaves_the_request_alone(self) -> None:
        """`plan` changes nothing in its request."""
        with self.loaded() as (planner, ctx):
            request = self.request(ctx, 8)
            assert isinstance(request.goal, JointGoal)
            start, goal = request.start.copy(), request.goal.positions.copy()
            planner.plan(request)
            np.testing.assert_array_equal(request.start, start)
            np.testing.assert_array_equal(request.goal.positions, goal)

    def test_close_is_safe_twice(self) -> None:
        """`close` may come before `load` and twice."""
        planner = self.make(self.context())
        planner.close()
        planner.load()
        planner.close()
        planner.close()


def check_limits(trajectory: JointTrajectory, request: PlanRequest, ctx: Context, samples: int) -> None:
    """Assert that a trajectory, splined by the fields that it gives, stays within the robot's scaled limits."""
    order = ctx.robot.indices(request.joints)
    lower, upper = ctx.robot.lower[order], ctx.robot.upper[order]
    max_velocity = ctx.robot.max_velocity[order] * request.velocity_scaling
    max_acceleration = ctx.robot.max_acceleration[order] * request.acceleration_scaling
    for a, b in zip(trajectory.points, trajectory.points[1:], strict=False):
        duration = seconds(b.time_from_start_ns - a.time_from_start_ns)
        spline = _spline(a.positions, b.positions, a.velocities, b.velocities, duration)
        shares = np.linspace(0.0, 1.0, samples)[:, None]
        position = sum(c * shares**k for k, c in enumerate(spline))
        velocity = sum(k * c * shares ** (k - 1) for k, c in enumerate(spline) if k) / duration
        at = f"{seconds(a.time_from_start_ns):.3f} s"
        assert (position >= lower - 1e-6).all(), f"below the limit near {at}"
        assert (position <= upper + 1e-6).all(), f"above the limit near {at}"
        assert (np.abs(velocity) <= max_velocity * 1.01 + 1e-6).all(), f"too fast near {at}"
        if a.velocities.size:
            # The mean over the segment: at a corner of the profile the cubic itself may overshoot a little.
            mean = np.abs(b.velocities - a.velocities) / duration
            assert (mean <= max_acceleration * 1.01 + 1e-6).all(), f"accelerates too much near {at}"


def _spline(p0: Vector, p1: Vector, v0: Vector, v1: Vector, duration: float) -> list[Vector]:
    """Coefficients over the share of the segment: linear without velocities, cubic with them."""
    if not v0.size:
        return [p0, p1 - p0]
    d0, d1 = v0 * duration, v1 * duration
    return [p0, d0, 3 * (p1 - p0) - 2 * d0 - d1, 2 * (p0 - p1) + d0 + d1]


class FakePlanner(Planner):
    """A cubic from start to goal for all joints together, slow enough for the slowest."""

    def __init__(self, ctx: Context) -> None:
        self._robot = ctx.robot

    @override
    def plan(self, request: PlanRequest) -> PlanResult:
        if not isinstance(request.goal, JointGoal):
            raise PlanningError(
                f"the fake planner knows joint goals only, not {type(request.goal).__name__}",
                PlanCode.UNRECOGNIZED_GOAL_TYPE,
            )
        unknown = set(request.goal.joints) - set(request.joints)
        if unknown:
            raise PlanningError(f"no joint {min(unknown)!r} in the request; it has: {', '.join(request.joints)}")
        end = request.start.copy()
        end[[request.joints.index(joint) for joint in request.goal.joints]] = request.goal.positions
        order = self._robot.indices(request.joints)
        for joint, position, lower, upper in zip(
            request.joints, end, self._robot.lower[order], self._robot.upper[order], strict=True
        ):
            if not lower <= position <= upper:
                raise PlanningError(f"{joint}: {position} rad is outside {lower} to {upper} rad")
        way = np.abs(end - request.start)
        velocity = self._robot.max_velocity[order] * request.velocity_scaling
        acceleration = self._robot.max_acceleration[order] * request.acceleration_scaling
        # Peaks of a cubic over time T: velocity 1.5 distance / T, acceleration 6 distance / T^2.
        duration = max((1.5 * way / velocity).max(), np.sqrt(6 * way / acceleration).max(), 0.01)
        points = tuple(_cubic_point(request.start, end, duration, share) for share in np.linspace(0.0, 1.0, 50))
        return PlanResult(JointTrajectory(Header(), request.joints, points))


def _cubic_point(start: Vector, end: Vector, duration: float, share: float) -> JointTrajectoryPoint:
    position = start + (end - start) * (3 * share**2 - 2 * share**3)
    velocity = (end - start) * (6 * share - 6 * share**2) / duration
    return JointTrajectoryPoint(ns(duration * share), position, velocity)


class FakeGuard(Guard):
    """Keeps the sum of all positions below a limit.

    A change of the world, `{"most": 2.0}`, sets another limit.

    Args:
        ctx: provides the joints.
        most: largest sum of the positions [rad].
    """

    def __init__(self, ctx: Context, most: float = 3.0) -> None:
        self._joints = ctx.robot.joint_names
        self._most = most
        self.counts = {"held": 0}

    @override
    def accept(self, position: Vector, velocity: Vector, setpoint: Vector, measured: Vector) -> Vector:
        if setpoint.sum() <= max(self._most, position.sum()):
            self.overruled = ""
            return setpoint
        self.counts = {"held": self.counts["held"] + 1}
        if not self.overruled:
            distance = self._most - float(position.sum())
            text = f"the joints were {distance:.3f} rad from their limit"
            pair = {"first": self._joints[0], "second": "the limit", "distance": distance, "text": text}
            self.overruled = json.dumps(pair)
        return position

    @override
    def world(self, change: Mapping[str, Any]) -> None:
        most = change.get("most")
        if not isinstance(most, float) or not np.isfinite(most):
            raise HardwareError(f"a change of the world needs most, a number [rad]; got {dict(change)}")
        self._most = most
