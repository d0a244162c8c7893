"""The `gripper` executor: opens or closes to a position; an object that stops it counts as grasped."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import (
    Context,
    Executor,
    ExecutorGoal,
    GoalRejected,
    GoalState,
    GoalStatus,
    JointReading,
    MoveJoint,
    NotSupported,
    SlowDown,
    Vector,
    ns,
    seconds,
)
from ibrobot_planning.executors.options import GripperOptions
from ibrobot_planning.guard_label import in_words, touches

_STRONGEST = 1000.0
"""Largest `max_effort` of a goal [Nm]; 0 stands for no limit."""
_SHARE = 0.99
"""Share of the acceleration limit that is used, so that rounding does not exceed it."""


@attrs.define
class _Running:
    goal_id: str
    stops: bool = False
    """Whether it only slows down."""
    still_ns: int = 0
    """Time with setpoints since the gripper last moved [ns]."""


class GripperExecutor(Executor):
    """Moves one joint's setpoint to the goal at `velocity`, and keeps it there regardless of the result.

    It accelerates and brakes within the joint's limit, also from one goal to the next.

    Reached: the measured position is within `goal_tolerance` of the goal. Stalled: the measured speed has been below
    `stall_velocity` for `stall_time`; something is in the way. With `allow_stalling` that is a success (grasped) and
    the setpoint goes on to the goal, so that the gripper keeps squeezing; without it, the goal is aborted and the
    measured position held, as by `cancel`; so it is if the guard holds it back before it touches. The goal `SlowDown`
    slows down and holds. With `max_effort` the setpoint stays while the measured effort is at or above it, also after
    the goal has ended.
    """

    def __init__(self, options: GripperOptions, ctx: Context) -> None:
        if len(ctx.joints) != 1:
            owned = ", ".join(ctx.joints)
            raise NotSupported(
                f"executor {ctx.name}: a gripper has one joint, this group has {len(ctx.joints)}: {owned}"
            )
        self.joints = ctx.joints
        self._options = options
        joint = ctx.robot.joints[int(ctx.robot.indices(ctx.joints)[0])]
        self._lower, self._upper = joint.lower, joint.upper
        self._period_s = period_s = seconds(ctx.period_ns)
        self._max_step = joint.max_velocity * period_s
        self._fastest = self._most = min(options.velocity * period_s, self._max_step)
        """Largest step of the setpoint [rad], of any goal and of the present one."""
        self._change = _SHARE * joint.max_acceleration * period_s**2
        self._stall_ns = ns(options.stall_time)
        # Longer pauses are missed ticks: a gripper that stood without setpoints has not stalled.
        self._longest_ns = 2 * ctx.period_ns
        self._setpoint = self._target = math.nan
        self._step = 0.0
        """The last step of the setpoint [rad]."""
        self._max_effort = 0.0
        self._stamp_ns = 0
        self._running: _Running | None = None
        self._statuses: deque[GoalStatus] = deque()
        self._held_back = ""
        """What the guard kept the last setpoint from."""

    @override
    def activate(self, measured: JointReading) -> None:
        self.deactivate()
        self._setpoint = self._target = float(measured.position[0])
        self._step = 0.0
        self._stamp_ns = measured.stamp_ns

    @override
    def deactivate(self) -> None:
        self._end(GoalState.CANCELED, "the executor was deactivated")
        self._setpoint = self._target = math.nan

    @override
    def set_goal(self, goal_id: str, goal: ExecutorGoal, measured: JointReading) -> None:
        """Begin to open or close.

        Raises:
            GoalRejected: e.g. a position outside the joint's limits; the old goal goes on.
        """
        if math.isnan(self._setpoint):
            raise GoalRejected("the executor is not active")
        if isinstance(goal, SlowDown):
            rest = float(measured.position[0])
            if abs(self._setpoint + self._braking_distance() - rest) > self._fastest:  # the commands lag behind
                self._setpoint, self._step = rest, 0.0
            self._begin(_Running(goal_id, stops=True), self._setpoint + self._braking_distance())
            return
        if not isinstance(goal, MoveJoint):
            raise GoalRejected(f"expected a position, got {goal}")
        position, max_effort, speed = goal.position, goal.max_effort, goal.speed
        for name, value in (("position", position), ("max_effort", max_effort), ("speed", speed)):
            if not math.isfinite(value):
                raise GoalRejected(f"{name} must be a finite number, got {value!r}")
        if not self._lower <= position <= self._upper:
            raise GoalRejected(
                f"position {position:.6g} rad is outside the limits of {self.joints[0]}, "
                f"{self._lower:.6g} to {self._upper:.6g}"
            )
        if not 0 <= max_effort <= _STRONGEST:
            raise GoalRejected(f"max_effort is {max_effort:.6g} Nm; it must be from 0, for no limit, to {_STRONGEST:g}")
        if max_effort > 0 and not np.isfinite(measured.effort[0]):
            raise GoalRejected(f"max_effort cannot be kept: {self.joints[0]} has no measured effort; leave it out")
        if not 0 < speed <= 1:
            raise GoalRejected(f"speed is {speed:.6g}; it must be a fraction above 0, up to 1")
        self._begin(_Running(goal_id), position)
        self._max_effort, self._most = max_effort, min(self._fastest, speed * self._max_step)

    def _begin(self, goal: _Running, target: float) -> None:
        self._end(GoalState.CANCELED, f"replaced by goal {goal.goal_id}")
        self._running, self._target = goal, target
        self._statuses.append(GoalStatus(goal.goal_id, GoalState.EXECUTING))

    def _braking_distance(self) -> float:
        """How far the setpoint moves before it comes to rest [rad]."""
        ticks = math.floor(abs(self._step) / self._change)
        return math.copysign(ticks * (abs(self._step) - (ticks + 1) * self._change / 2), self._step)

    @override
    def update(self, measured: JointReading) -> Vector:
        if measured.stamp_ns > self._stamp_ns:
            # Written so that an effort that is no longer measured stops it.
            squeezes = self._max_effort > 0 and not abs(measured.effort[0]) < self._max_effort
            self._step = 0.0 if squeezes else self._next_step()
            self._setpoint += self._step
        passed_ns = min(measured.stamp_ns - self._stamp_ns, self._longest_ns)
        self._stamp_ns = measured.stamp_ns
        if self._running is not None:
            self._judge(self._running, measured, passed_ns)
        self._held_back = ""
        return np.array([self._setpoint])

    @override
    def note_guard(self, overruled: str) -> None:
        self._held_back = "" if touches(overruled) else overruled

    @override
    def cancel(self, measured: JointReading) -> None:
        if self._running is not None:
            self._hold(measured)
            self._end(GoalState.CANCELED, "cancelled", self._result(measured))

    @override
    def pop_status(self) -> GoalStatus | None:
        return self._statuses.popleft() if self._statuses else None

    def _next_step(self) -> float:
        """The step of this tick towards the target [rad], within velocity and acceleration."""
        gap = self._target - self._setpoint
        # From a step u, then u - D, u - 2 D, …, the setpoint comes to rest within the gap.
        ticks = math.floor((math.sqrt(1 + 8 * abs(gap) / self._change) - 1) / 2)
        most = min(abs(gap) / (ticks + 1) + ticks * self._change / 2, self._most)
        return min(max(math.copysign(most, gap), self._step - self._change), self._step + self._change)

    def _judge(self, running: _Running, measured: JointReading, passed_ns: int) -> None:
        """End the goal if it is reached or the gripper has stalled."""
        if running.stops:
            if self._setpoint == self._target or self._step == 0:
                self._end(GoalState.SUCCEEDED, "", self._result(measured))
            return
        # Written so that a NaN speed counts as moving: a stall must be measured. A gripper that may only creep has not
        # stalled.
        moves = not abs(measured.velocity[0]) < min(self._options.stall_velocity, self._most / self._period_s / 2)
        running.still_ns = 0 if moves else running.still_ns + passed_ns
        if abs(measured.position[0] - self._target) <= self._options.goal_tolerance:
            self._end(GoalState.SUCCEEDED, "", self._result(measured, reached_goal=True))
        elif running.still_ns >= self._stall_ns:
            result = self._result(measured, stalled=True)
            why = f"stalled at {measured.position[0]:.4g} rad on the way to {self._target:.6g}"
            if self._held_back:  # it stands before something that it does not touch
                self._hold(measured)
                self._end(GoalState.ABORTED, f"the guard: {in_words(self._held_back)}", result)
            elif self._options.allow_stalling:
                self._end(GoalState.SUCCEEDED, why, result)
            else:
                self._hold(measured)
                self._end(GoalState.ABORTED, why, result)

    def _hold(self, measured: JointReading) -> None:
        if np.isfinite(measured.position[0]):
            self._setpoint = float(measured.position[0])
        self._target, self._step = self._setpoint, 0.0

    def _result(self, measured: JointReading, *, stalled: bool = False, reached_goal: bool = False) -> dict[str, Any]:
        return {"position": float(measured.position[0]), "stalled": stalled, "reached_goal": reached_goal}

    def _end(self, state: GoalState, message: str, result: Mapping[str, Any] | None = None) -> None:
        if self._running is not None:
            self._statuses.append(GoalStatus(self._running.goal_id, state, message, result or {}))
            self._running = None
