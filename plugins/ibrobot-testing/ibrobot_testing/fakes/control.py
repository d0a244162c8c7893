"""Fakes of components in the control process: hardware and executors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import override

import numpy as np

from ibrobot_core.api import (
    NS_PER_S,
    Context,
    EpisodeSetup,
    Executor,
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    GoalState,
    GoalStatus,
    Hardware,
    HardwareError,
    JointReading,
    Plan,
    Signal,
    SimulatedHardware,
    Torque,
    Vector,
    nan_vector,
    seconds,
)


class FakeHardware(SimulatedHardware):
    """Joints that follow their command with a first-order lag; a reset sets random positions near the middle.

    Args:
        ctx: provides the joints.
        lag_s: time constant [s].
    """

    signals = (Signal("/fake/command", 1, "largest distance to the command [rad]"),)

    def __init__(self, ctx: Context, lag_s: float = 0.1) -> None:
        self.joints = ctx.joints
        self._ctx = ctx
        self._lag_s = lag_s
        self._open = False
        self.relaxed = False
        self._position: Vector = np.zeros(len(ctx.joints))
        self.reset(EpisodeSetup(ctx.seed))

    @override
    def connect(self) -> None:
        self._command = self._position.copy()
        self._open = True

    @override
    def read(self) -> JointReading:
        self._check_open()
        stamp_ns = self._ctx.clock.now_ns()
        return JointReading(stamp_ns, self._position.copy(), self._velocity.copy(), nan_vector(len(self.joints)))

    @override
    def write(self, position: Vector) -> None:
        self._check_open()
        if position.shape != self._position.shape:
            raise HardwareError(f"position must have shape {self._position.shape}, got {position.shape}")
        self._command = position.copy()
        self.relaxed = False

    @override
    def disconnect(self) -> None:
        self._open = False

    @override
    def relax(self) -> Torque:
        self._check_open()
        self.relaxed = True
        return Torque.OFF

    @override
    def read_signal(self, index: int, out: Vector) -> None:
        out[:] = np.abs(self._command - self._position).max()

    @override
    def advance(self, step_ns: int) -> None:
        before = self._position
        if not self.relaxed:
            self._position = before + (self._command - before) * -np.expm1(-seconds(step_ns) / self._lag_s)
        self._velocity = (self._position - before) / seconds(step_ns)

    @override
    def reset(self, episode: EpisodeSetup) -> None:
        order = self._ctx.robot.indices(self.joints)
        lower, upper = self._ctx.robot.lower[order], self._ctx.robot.upper[order]
        share = np.random.default_rng(episode.seed).uniform(0.4, 0.6, len(self.joints))
        self._position = lower + share * (upper - lower)
        self._velocity = np.zeros(len(self.joints))
        self._command = self._position.copy()

    def _check_open(self) -> None:
        if not self._open:
            raise HardwareError("the fake hardware is not connected")


class FakeRealHardware(Hardware):
    """Joints that follow their command as time passes, like those of a real robot.

    Args:
        ctx: provides the joints and the clock.
        lag_s: time constant [s].
    """

    def __init__(self, ctx: Context, lag_s: float = 0.1) -> None:
        self._joints = FakeHardware(ctx, lag_s)
        self._clock = ctx.clock
        self._moved_ns = ctx.clock.now_ns()
        self.joints = ctx.joints

    @override
    def connect(self) -> None:
        self._joints.connect()
        self._moved_ns = self._clock.now_ns()

    @override
    def read(self) -> JointReading:
        self._catch_up()
        return self._joints.read()

    @override
    def write(self, position: Vector) -> None:
        self._catch_up()
        self._joints.write(position)

    @override
    def disconnect(self) -> None:
        self._joints.disconnect()

    def _catch_up(self) -> None:
        now_ns = self._clock.now_ns()
        if now_ns > self._moved_ns:
            self._joints.advance(now_ns - self._moved_ns)
        self._moved_ns = now_ns


class _HoldingExecutor(Executor):
    """Holds the position at activation; a goal ends with the setpoint where the joints are.

    Subclasses override `deactivate`, which ends their motion, and call it from there.
    """

    def __init__(self, ctx: Context) -> None:
        self.joints = ctx.joints
        self._setpoint: Vector = np.zeros(len(ctx.joints))
        self._statuses: list[GoalStatus] = []
        self.deactivate()

    @override
    def activate(self, measured: JointReading) -> None:
        self._setpoint = measured.position.copy()

    @override
    def deactivate(self) -> None:
        self._goal_id: str | None = None

    @override
    def cancel(self, measured: JointReading) -> None:
        if self._goal_id is not None:
            self._end_goal(GoalState.CANCELED)
            self._setpoint = measured.position.copy()

    @override
    def pop_status(self) -> GoalStatus | None:
        return self._statuses.pop(0) if self._statuses else None

    def _begin_goal(self, goal_id: str) -> None:
        self._goal_id = goal_id
        self._statuses.append(GoalStatus(goal_id, GoalState.EXECUTING))

    def _end_goal(self, state: GoalState) -> None:
        if self._goal_id is not None:
            self._statuses.append(GoalStatus(self._goal_id, state))
            self._goal_id = None


class FakeExecutor(_HoldingExecutor):
    """Accepts plans, read at their nearest point, and the end of a trajectory, approached at constant speed.

    A plan is stale a second after its last point.
    """

    accepts_plans = True
    _is_stale = False

    def __init__(self, ctx: Context) -> None:
        super().__init__(ctx)
        self._step = 0.5 * ctx.robot.max_velocity[ctx.robot.indices(ctx.joints)] * seconds(ctx.period_ns)
        self._refused = 0
        self._goal: Vector = self._setpoint

    @override
    def activate(self, measured: JointReading) -> None:
        super().activate(measured)
        self._is_stale = False

    @override
    def deactivate(self) -> None:
        super().deactivate()
        self._plan: Plan | None = None
        self._is_stale = False

    @property
    @override
    def is_stale(self) -> bool:
        return self._is_stale

    @override
    def update(self, measured: JointReading) -> Vector:
        plan = self._plan
        if plan is not None and measured.stamp_ns - plan.start_ns - len(plan.positions) * plan.step_ns > NS_PER_S:
            self._plan, self._is_stale = None, True
        if plan is not None and measured.stamp_ns >= plan.start_ns:
            index = min((measured.stamp_ns - plan.start_ns) // plan.step_ns, len(plan.positions) - 1)
            self._setpoint = plan.positions[index].copy()
        if self._goal_id is not None:
            self._setpoint = self._setpoint + np.clip(self._goal - self._setpoint, -self._step, self._step)
            if np.array_equal(self._setpoint, self._goal):
                self._end_goal(GoalState.SUCCEEDED)
        return self._setpoint.copy()

    @override
    def set_plan(self, plan: Plan) -> None:
        if plan.positions.shape[1:] != self._setpoint.shape or not np.isfinite(plan.positions).all():
            self._refused += 1
            return
        self._plan, self._is_stale = plan, False

    @override
    def set_goal(self, goal_id: str, goal: ExecutorGoal, measured: JointReading) -> None:
        self._goal = _positions(goal, self.joints)[-1]
        self._begin_goal(goal_id)

    @override
    def counters(self) -> Mapping[str, int]:
        return {"refused_plans": self._refused}


def _positions(goal: ExecutorGoal, joints: tuple[str, ...]) -> Vector:
    """The positions of a trajectory's points in the order of the joints [rad], shape (N, J)."""
    try:
        assert isinstance(goal, FollowTrajectory)
        order = [goal.trajectory.joint_names.index(joint) for joint in joints]
        positions = np.stack([point.positions[order] for point in goal.trajectory.points])
        assert np.isfinite(positions).all()
    except (AssertionError, IndexError, ValueError) as error:
        raise GoalRejected(f"not a trajectory of {', '.join(joints)}: {goal!r}") from error
    return positions


class FakeTrajectoryExecutor(_HoldingExecutor):
    """Accepts trajectories, and interpolates their positions linearly.

    A goal succeeds once the joints are within 0.02 rad of its end.
    """

    @override
    def set_goal(self, goal_id: str, goal: ExecutorGoal, measured: JointReading) -> None:
        positions = _positions(goal, self.joints)
        assert isinstance(goal, FollowTrajectory)
        times_ns = np.array([point.time_from_start_ns for point in goal.trajectory.points], np.float64)
        self._end_goal(GoalState.CANCELED)
        self._times_ns: Vector = measured.stamp_ns + np.concatenate(([0.0], times_ns))
        self._positions: Vector = np.vstack((self._setpoint, positions))
        self._begin_goal(goal_id)

    @override
    def update(self, measured: JointReading) -> Vector:
        if self._goal_id is not None:
            self._setpoint = np.array(
                [np.interp(measured.stamp_ns, self._times_ns, column) for column in self._positions.T]
            )
            at_end = np.abs(measured.position - self._positions[-1]).max() <= 0.02
            if measured.stamp_ns >= self._times_ns[-1] and at_end:
                self._end_goal(GoalState.SUCCEEDED)
        return self._setpoint.copy()
