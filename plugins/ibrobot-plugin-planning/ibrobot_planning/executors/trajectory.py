"""The `trajectory` executor: follows joint trajectories within tolerances, and reports how they ended."""

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
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    GoalState,
    GoalStatus,
    JointReading,
    SlowDown,
    Vector,
    ns,
    seconds,
)
from ibrobot_core.app import Spline
from ibrobot_planning.executors.options import TrajectoryOptions
from ibrobot_planning.executors.trajectory_goal import (
    PLAUSIBLE,
    CheckedTrajectory,
    Points,
    check_positions,
    check_rates,
    check_trajectory,
)
from ibrobot_planning.guard_label import in_words

LAG_S = 0.1
"""Longest lag of a joint behind its setpoint [s], as in ADR 16."""
START_TOLERANCE_RAD = 0.1
"""How far from the present setpoint a trajectory's point at time zero may lie."""
_HELD_BACK_S = 0.2
"""How long the guard may hold a trajectory back without a break until it is aborted [s]."""
_ROUNDING_RAD = 1e-9
"""Largest rounding error of a trajectory's polynomials at its points."""
_STOP_SHARE = 0.8
"""Share of the acceleration limits that a stop uses: it is computed tick by tick."""


@attrs.define(eq=False)
class _Stop:
    """Progress of a trajectory that slows down."""

    stamp_ns: int
    phase_ns: float
    """Time along the trajectory [ns]."""
    rate: float = 1.0
    """Rate at which that time passes, from 1 to 0."""


@attrs.frozen(eq=False)
class _Running:
    goal_id: str
    goal: CheckedTrajectory
    begin_ns: int
    spline: Spline
    stop: _Stop | None = None


class TrajectoryExecutor(Executor):
    """Interpolates a goal's points by the fields given: linear, cubic with velocities, quintic with accelerations.

    A trajectory begins at the present setpoint, velocity and acceleration (the latter if its points have these fields),
    so that a new goal replaces a running one without a step. A point at time zero must lie near the setpoint, which
    replaces it. The last point is held. Success: the measured position comes within the goal tolerance, at the end or
    up to `goal_time` after it. A joint further off its path than the path tolerance plus a servo's lag of 0.1 s, or
    late at the goal, aborts it; so does a guard that holds it back for 0.2 s. Aborting and cancelling hold the
    measured position.

    A trajectory with `takes_over` begins at a given time of the running one, with its setpoint, velocity and
    acceleration at that time. The goal `SlowDown` slows down along the trajectory under way, within the
    acceleration limits, and holds where it comes to rest.

    Trajectories advance by one control period per tick: missed ticks delay them, and skip nothing.
    """

    def __init__(self, options: TrajectoryOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        self._options = options
        indices = ctx.robot.indices(ctx.joints)
        self._lower, self._upper = ctx.robot.lower[indices], ctx.robot.upper[indices]
        self._velocity, self._acceleration = ctx.robot.max_velocity[indices], ctx.robot.max_acceleration[indices]
        self._period_ns = ctx.period_ns
        self._held: Vector | None = None
        self._running: _Running | None = None
        self._next: _Running | None = None
        """Takes over from the running trajectory when it begins."""
        self._now_ns = self._stamp_ns = 0
        """Time, advanced by at most a period per tick, and the time of the last tick."""
        self._statuses: deque[GoalStatus] = deque()
        self._held_back, self._held_back_ns = "", 0
        """What the guard kept the last setpoint from, and for how long without a break [ns]."""

    @override
    def activate(self, measured: JointReading) -> None:
        self.deactivate()
        self._held = measured.position.copy()
        self._now_ns = self._stamp_ns = measured.stamp_ns

    @override
    def deactivate(self) -> None:
        self._end(GoalState.CANCELED, "the executor was deactivated")
        self._held = None

    @override
    def set_goal(self, goal_id: str, goal: ExecutorGoal, measured: JointReading) -> None:
        """Begin a trajectory.

        Raises:
            GoalRejected: e.g. times that do not increase, a velocity at the end, or a time to take over that has
                passed; the old goal goes on.
        """
        if self._held is None:
            raise GoalRejected("the executor is not active")
        if isinstance(goal, SlowDown):
            self._begin_stop(goal_id)
            return
        if not isinstance(goal, FollowTrajectory):
            raise GoalRejected(f"expected a trajectory, got {goal}")
        checked = check_trajectory(goal, self.joints, self._options)
        check_rates(checked.points, self.joints, self._velocity, self._acceleration, PLAUSIBLE)
        begin_ns = self._now_ns if goal.takes_over is None else self._takeover_ns(goal.takes_over, goal.at_ns)
        following = _Running(goal_id, checked, begin_ns, self._spline(checked.points, begin_ns))
        if self._next is not None:
            self._statuses.append(GoalStatus(self._next.goal_id, GoalState.CANCELED, f"replaced by goal {goal_id}"))
        self._next = following
        if goal.takes_over is None:
            self._begin_next()

    def _takeover_ns(self, name: str, at_ns: int) -> int:
        running = self._running
        if running is None or running.goal_id != name or running.stop is not None:
            raise GoalRejected(f"goal {name} does not run, so no trajectory can take over from it")
        begin_ns = running.begin_ns + at_ns
        if not self._now_ns <= begin_ns <= running.spline.end_ns:
            raise GoalRejected(
                f"the trajectory takes over at {at_ns} ns of goal {name}, which is at "
                f"{self._now_ns - running.begin_ns} ns and ends at {running.spline.end_ns - running.begin_ns} ns"
            )
        return begin_ns

    def _begin_next(self) -> None:
        """Let the next trajectory take over from the running one."""
        following, self._next = self._next, None
        assert following is not None
        self._end(GoalState.CANCELED, f"replaced by goal {following.goal_id}")
        self._running = following
        begin_ns = self._stamp_ns - (self._now_ns - following.begin_ns)
        self._statuses.append(GoalStatus(following.goal_id, GoalState.EXECUTING, "", {"begin_ns": begin_ns}))

    def _begin_stop(self, goal_id: str) -> None:
        running = self._running
        self._end(GoalState.CANCELED, f"stopped by goal {goal_id}")
        self._statuses.append(GoalStatus(goal_id, GoalState.EXECUTING))
        if running is None:
            self._statuses.append(GoalStatus(goal_id, GoalState.SUCCEEDED))
        else:
            stop = running.stop or _Stop(self._now_ns, self._now_ns)
            self._running = attrs.evolve(running, goal_id=goal_id, stop=stop)

    @override
    def update(self, measured: JointReading) -> Vector:
        self._now_ns += min(max(measured.stamp_ns - self._stamp_ns, 0), self._period_ns)
        self._stamp_ns = measured.stamp_ns
        if self._next is not None and self._now_ns >= self._next.begin_ns:
            self._begin_next()
        stop = self._running.stop if self._running is not None else None
        if self._running is not None and stop is not None:
            self._slow_down(self._running.spline, stop, self._now_ns)
        setpoint, velocity, _ = self._sample(self._now_ns)
        setpoint = self._without_rounding(setpoint)
        running = self._running
        held_back, self._held_back = self._held_back, ""
        self._held_back_ns = self._held_back_ns + self._period_ns if held_back else 0
        if running is None:
            return setpoint.copy()
        error = np.abs(setpoint - measured.position)
        if stop is not None and stop.rate == 0:
            self._held = setpoint.copy()
            self._end(GoalState.SUCCEEDED, "")
            return setpoint.copy()
        is_held_back = self._held_back_ns >= ns(_HELD_BACK_S)
        if is_held_back or stop is not None or self._now_ns < running.spline.end_ns:
            beyond = _exceeds(error - LAG_S * np.abs(velocity), running.goal.path_tolerance)
            if is_held_back or beyond.any():
                why = f"the guard: {in_words(held_back)}" if is_held_back else self._off_path(beyond, error, running)
                return self._stop(GoalState.ABORTED, why, measured, {"exceeded": "path"})
            return setpoint
        beyond = _exceeds(error, running.goal.goal_tolerance)
        if not beyond.any():
            self._held = setpoint
            self._end(GoalState.SUCCEEDED, "")
        elif running.goal.goal_time_ns and self._now_ns >= running.spline.end_ns + running.goal.goal_time_ns:
            why = self._deviation(beyond, error, running.goal.goal_tolerance, "off its goal")
            late = f"{why} {seconds(running.goal.goal_time_ns):.6g} s after the end"
            return self._stop(GoalState.ABORTED, late, measured, {"exceeded": "goal"})
        return setpoint.copy()

    @override
    def note_guard(self, overruled: str) -> None:
        self._held_back = overruled

    @override
    def cancel(self, measured: JointReading) -> None:
        if self._running is not None:
            self._stop(GoalState.CANCELED, "cancelled", measured)

    @override
    def pop_status(self) -> GoalStatus | None:
        return self._statuses.popleft() if self._statuses else None

    def _without_rounding(self, setpoint: Vector) -> Vector:
        """The setpoint without rounding beyond a limit, which the safety layer would count as a correction."""
        inside = np.clip(setpoint, self._lower, self._upper)
        return np.where(np.abs(setpoint - inside) <= _ROUNDING_RAD, inside, setpoint)

    def _sample(self, now_ns: int) -> tuple[Vector, Vector, Vector]:
        """The setpoint at `now_ns` [ns] of the executor's time, with its velocity and acceleration, each shape (J,)."""
        running = self._running
        if running is not None and running.stop is not None:
            position, velocity, acceleration = running.spline.at(round(running.stop.phase_ns))
            return position, velocity * running.stop.rate, acceleration * running.stop.rate**2
        if running is not None:
            return running.spline.at(now_ns)
        assert self._held is not None, "an executor is activated before it is updated"
        return self._held, np.zeros_like(self._held), np.zeros_like(self._held)

    def _slow_down(self, spline: Spline, stop: _Stop, now_ns: int) -> None:
        """Advance a stop to `now_ns` [ns]."""
        passed_ns = now_ns - stop.stamp_ns
        ends = (stop.phase_ns, stop.phase_ns + stop.rate * passed_ns)
        # Acceleration of a joint: velocity * (change of the rate) + acceleration * rate^2, both of the spline.
        change = min(0.0, max(self._fastest_change(spline, end_ns, stop.rate) for end_ns in ends))
        rate = max(0.0, stop.rate + change * seconds(passed_ns))
        stop.phase_ns = min(stop.phase_ns + (stop.rate + rate) / 2 * passed_ns, spline.end_ns)
        stop.stamp_ns, stop.rate = now_ns, rate if stop.phase_ns < spline.end_ns else 0.0

    def _fastest_change(self, spline: Spline, phase_ns: float, rate: float) -> float:
        """Steepest permitted change of the rate [1/s], negative."""
        _, velocity, acceleration = spline.at(round(phase_ns))
        moving = velocity != 0
        if not moving.any():
            return -np.inf
        left = _STOP_SHARE * self._acceleration + np.sign(velocity) * acceleration * rate**2
        return float((-left[moving] / np.abs(velocity[moving])).max())

    def _spline(self, points: Points, begin_ns: int) -> Spline:
        """A spline through a goal's points, from the setpoint at `begin_ns` [ns]."""
        position, velocity, acceleration = self._sample(begin_ns)
        times_ns, positions = points.times_ns, points.positions
        velocities, accelerations = points.velocities, points.accelerations
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
        outside = (positions[-1] < self._lower) | (positions[-1] > self._upper)
        if outside.any():
            joint = int(outside.argmax())
            raise GoalRejected(
                f"the last point has {self.joints[joint]} at {positions[-1, joint]:.6g} rad, outside its limits "
                f"{self._lower[joint]:.6g} to {self._upper[joint]:.6g}"
            )
        times_ns, fields = np.concatenate(([begin_ns], begin_ns + times_ns)), [np.vstack((position, positions))]
        for start, values in ((velocity, velocities), (acceleration, accelerations)):
            if values is not None:
                fields.append(np.vstack((start, values)))
        check_positions(times_ns, fields, self.joints, self._lower, self._upper)
        return Spline(times_ns, *fields)

    def _stop(
        self, state: GoalState, why: str, measured: JointReading, result: Mapping[str, Any] | None = None
    ) -> Vector:
        """End the goal and hold the measured position [rad], shape (J,)."""
        setpoint, _, _ = self._sample(self._now_ns)
        self._held = np.where(np.isfinite(measured.position), measured.position, setpoint)
        self._end(state, why, result)
        return self._held.copy()

    def _end(self, state: GoalState, message: str, result: Mapping[str, Any] | None = None) -> None:
        """End the running goal, and the one that is to take over from it."""
        if self._next is not None:
            self._statuses.append(GoalStatus(self._next.goal_id, GoalState.CANCELED, message))
            self._next = None
        if self._running is not None:
            self._statuses.append(GoalStatus(self._running.goal_id, state, message, result or {}))
            self._running = None

    def _off_path(self, beyond: NDArray[np.bool_], error: Vector, running: _Running) -> str:
        why = self._deviation(beyond, error, running.goal.path_tolerance, "off its path")
        return f"{why}, beyond a lag of {LAG_S} s"

    def _deviation(self, beyond: NDArray[np.bool_], error: Vector, tolerance: Vector, what: str) -> str:
        joint = int(beyond.argmax())
        return f"{self.joints[joint]} is {error[joint]:.4g} rad {what} (tolerance {tolerance[joint]:.6g})"


def _exceeds(error: Vector, tolerance: Vector) -> NDArray[np.bool_]:
    """Where `error` is not within `tolerance`; a tolerance of 0 is not checked, NaN is outside."""
    return (tolerance > 0) & ~(error <= tolerance)
