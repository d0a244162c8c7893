"""The `trajectory` executor: follows joint trajectories within tolerances and says how they ended."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import (
    Context,
    Executor,
    GoalRejected,
    GoalState,
    GoalStatus,
    JointReading,
    Spline,
    Vector,
    seconds,
)
from ibrobot_planning.executors.options import TrajectoryOptions
from ibrobot_planning.executors.trajectory_goal import TrajectoryGoal, parse_goal

START_TOLERANCE_RAD = 0.1
"""How far from the present setpoint a trajectory's point at time zero may lie."""


@attrs.frozen(eq=False)
class _Running:
    goal_id: str
    goal: TrajectoryGoal
    spline: Spline


class TrajectoryExecutor(Executor):
    """Interpolates a goal's points by the fields given: linear, cubic with velocities, quintic with accelerations.

    A trajectory begins at the setpoint of the moment, and at its velocity and acceleration where its points have these
    fields, so a new goal replaces a running one without a step. A point at time zero says where the trajectory was
    planned from: it must lie near the setpoint, which then stands for it. The last point is held. Success: the measured
    position comes within the goal tolerance, at the end or up to `goal_time` after it. A joint further off its path
    than the path tolerance, or late, aborts the goal. Aborting and cancelling hold the measured position.
    """

    def __init__(self, options: TrajectoryOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        self._options = options
        indices = ctx.robot.indices(ctx.joints)
        self._lower, self._upper = ctx.robot.lower[indices], ctx.robot.upper[indices]
        self._held: Vector | None = None
        self._running: _Running | None = None
        self._statuses: deque[GoalStatus] = deque()

    @override
    def activate(self, measured: JointReading) -> None:
        self.deactivate()
        self._held = measured.position.copy()

    @override
    def deactivate(self) -> None:
        self._end(GoalState.CANCELED, "the executor was deactivated")
        self._held = None

    @override
    def set_goal(self, goal_id: str, goal: Mapping[str, Any], measured: JointReading) -> None:
        """Begin a trajectory.

        Args:
            goal_id: names it in `pop_status`.
            goal: `trajectory`: `joint_names` and `points`, each of `time_from_start_ns`, `positions` and, in all
                points or in none, `velocities`, `accelerations`; optionally `path_tolerance` and `goal_tolerance`
                [rad], a number or one by joint name, and `goal_time` [s]: 0 means the options' value, -1 none.
            measured: the joints now; its stamp is when the trajectory starts.

        Raises:
            GoalRejected: e.g. times that do not increase, or a velocity at the end; the old goal goes on.
        """
        if self._held is None:
            raise GoalRejected("the executor is not active")
        parsed = parse_goal(goal, self.joints, self._options)
        outside = (parsed.positions[-1] < self._lower) | (parsed.positions[-1] > self._upper)
        if outside.any():
            joint = int(outside.argmax())
            raise GoalRejected(
                f"the last point has {self.joints[joint]} at {parsed.positions[-1, joint]:.6g} rad, outside its limits "
                f"{self._lower[joint]:.6g} to {self._upper[joint]:.6g}"
            )
        spline = self._spline(parsed, measured.stamp_ns)
        self._end(GoalState.CANCELED, f"replaced by goal {goal_id}")
        self._running = _Running(goal_id, parsed, spline)
        self._statuses.append(GoalStatus(goal_id, GoalState.EXECUTING))

    @override
    def update(self, measured: JointReading) -> Vector:
        setpoint, _, _ = self._sample(measured.stamp_ns)
        running = self._running
        if running is None:
            return setpoint.copy()
        error = np.abs(setpoint - measured.position)
        if measured.stamp_ns < running.spline.end_ns:
            beyond = _exceeds(error, running.goal.path_tolerance)
            if beyond.any():
                why = self._deviation(beyond, error, running.goal.path_tolerance, "off its path")
                return self._stop(GoalState.ABORTED, why, measured)
            return setpoint
        beyond = _exceeds(error, running.goal.goal_tolerance)
        if not beyond.any():
            self._held = setpoint
            self._end(GoalState.SUCCEEDED, "")
        elif running.goal.goal_time_ns and measured.stamp_ns >= running.spline.end_ns + running.goal.goal_time_ns:
            why = self._deviation(beyond, error, running.goal.goal_tolerance, "off its goal")
            late = f"{why} {seconds(running.goal.goal_time_ns):.6g} s after the end"
            return self._stop(GoalState.ABORTED, late, measured)
        return setpoint.copy()

    @override
    def cancel(self, measured: JointReading) -> None:
        if self._running is not None:
            self._stop(GoalState.CANCELED, "cancelled", measured)

    @override
    def pop_status(self) -> GoalStatus | None:
        return self._statuses.popleft() if self._statuses else None

    def _sample(self, now_ns: int) -> tuple[Vector, Vector, Vector]:
        """The setpoint at `now_ns` [ns] with its velocity and acceleration, each shape (J,)."""
        if self._running is not None:
            return self._running.spline.at(now_ns)
        assert self._held is not None, "an executor is activated before it is updated"
        return self._held, np.zeros_like(self._held), np.zeros_like(self._held)

    def _spline(self, goal: TrajectoryGoal, now_ns: int) -> Spline:
        """The goal's points in time [ns], begun at the setpoint of the moment."""
        position, velocity, acceleration = self._sample(now_ns)
        times_ns, positions = goal.times_ns, goal.positions
        velocities, accelerations = goal.velocities, goal.accelerations
        if times_ns[0] == 0:
            off = np.abs(positions[0] - position)
            if off.max() > START_TOLERANCE_RAD:
                joint = int(off.argmax())
                raise GoalRejected(
                    f"the trajectory starts with {self.joints[joint]} at {positions[0, joint]:.6g} rad but it is at "
                    f"{position[joint]:.6g}; it must start within {START_TOLERANCE_RAD} rad, or above time 0"
                )
            times_ns, positions = times_ns[1:], positions[1:]
            velocities = None if velocities is None else velocities[1:]
            accelerations = None if accelerations is None else accelerations[1:]
        return Spline(
            np.concatenate(([now_ns], now_ns + times_ns)),
            np.vstack((position, positions)),
            None if velocities is None else np.vstack((velocity, velocities)),
            None if accelerations is None else np.vstack((acceleration, accelerations)),
        )

    def _stop(self, state: GoalState, why: str, measured: JointReading) -> Vector:
        """End the goal and hold the measured position [rad], shape (J,)."""
        setpoint, _, _ = self._sample(measured.stamp_ns)
        self._held = np.where(np.isfinite(measured.position), measured.position, setpoint)
        self._end(state, why)
        return self._held.copy()

    def _end(self, state: GoalState, message: str) -> None:
        if self._running is not None:
            self._statuses.append(GoalStatus(self._running.goal_id, state, message))
            self._running = None

    def _deviation(self, beyond: NDArray[np.bool_], error: Vector, tolerance: Vector, what: str) -> str:
        joint = int(beyond.argmax())
        return f"{self.joints[joint]} is {error[joint]:.4g} rad {what} (tolerance {tolerance[joint]:.6g})"


def _exceeds(error: Vector, tolerance: Vector) -> NDArray[np.bool_]:
    """Where `error` is not within `tolerance`; a tolerance of 0 is not checked, a NaN error is never within."""
    return (tolerance > 0) & ~(error <= tolerance)
