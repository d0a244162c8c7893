"""The safety layer: keeps every command to the motors within position, velocity and acceleration limits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces.guard import Guard
from ibrobot_core.robot import Robot, Vector
from ibrobot_core.units import seconds

KINDS = ("estop", "nonfinite", "unmeasured", "first_command", "position", "lead", "guard", "velocity", "acceleration")
"""Reasons for changing a desired setpoint. A joint counts once per tick, under the first reason that applies."""


class SafetyLayer:
    """Turns desired setpoints into hardware commands, one tick at a time.

    From `activate` on, at every tick and for every joint, for any desired setpoint:
    `lower <= p <= upper`, `|p - m| <= max_lead`, `|p - p'| <= max_velocity * dt` and
    `|(p - p') - (p' - p'')| <= max_acceleration * dt^2`, where p, p', p'' are the last three commands, m is the
    measured position and dt is the period. A step is taken only if braking from it at max_acceleration stops in time,
    so that braking never ends beyond a position limit, nor further than max_lead from the measured position.

    The inequalities are in order of precedence. The first two always hold, the first before the second. Setpoints use
    max_lead minus a reserve, in which the command still follows within the last two if an obstacle or a person moves
    a joint away from it. Beyond the reserve, the last two yield; if p' itself is too far from m, p starts at rest at
    max_lead from m.

    Setpoints within these limits pass unchanged, bit for bit. After a setpoint beyond them, the command catches up as
    fast as the limits allow and brakes so as not to overshoot.

    Not thread-safe; only the control loop uses it.

    Args:
        robot: joints and their limits; J is their number.
        period_ns: the control period [ns]; call `apply` once per period.
        guard: what may choose, for each joint, a command between that of the limits and braking.
    """

    def __init__(self, robot: Robot, period_ns: int, guard: Guard | None = None) -> None:
        if period_ns <= 0:
            raise ValueError(f"period_ns must be above 0, got {period_ns}")
        self._names = robot.joint_names
        self._period_s = seconds(period_ns)
        self._lower = robot.lower.astype(np.float64)
        self._upper = robot.upper.astype(np.float64)
        braking = robot.max_velocity**2 / (2 * robot.max_acceleration)
        usable = robot.max_lead - np.minimum(braking, robot.max_lead) / 4
        self._leads = np.array((robot.max_lead, usable))
        """Leads of commands and of setpoints; the difference suffices to change the speed by half of its limit."""
        # Velocities are steps [rad per tick] and accelerations changes of step, so that dt adds no rounding.
        max_step = robot.max_velocity * self._period_s
        self._change = robot.max_acceleration * self._period_s**2
        # A plan that runs exactly at a limit exceeds it by rounding, and braking along the limit must compensate
        # rounding: computed commands use half of the slack, setpoints passed unchanged all of it.
        largest = np.maximum(np.abs(self._lower), np.abs(self._upper))
        slack = np.maximum(1e-10 * np.minimum(max_step, self._change), 32 * np.spacing(largest))
        self._max_step, self._max_change, self._half_slack = max_step + slack / 2, self._change + slack / 2, slack / 2
        self._passed_change = self._max_change + self._half_slack
        # Only a quarter beyond the room to brake: the next step must compensate for it within the slack.
        self._reach_slack = self._half_slack / 4
        self._changes = np.broadcast_to(self._change, (2, 2, len(slack))).copy()  # NumPy is slower where it broadcasts
        self._highest = max_step + slack
        self._braking = (1.0 + 1e-9) * _distance(self._highest, self._change)
        """Braking from the highest step ends within it [rad]."""
        size = len(self._names)
        self._nothing: Vector = np.full(size, np.nan)
        self._counts = np.zeros((len(KINDS), size), dtype=np.int64)
        self._events = {"outside": 0, "wrong_length": 0, "missing": 0}
        self._estopped = False
        self._active = False
        self._guard = guard
        self.overruled = self.guard_fault = ""
        """As of the guard, and how it failed, in the last tick."""

    def activate(self, measured: Vector) -> None:
        """Start at rest from the measured positions [rad], shape (J,). Call it again when torque returns.

        A joint outside its limits may stay there or move inwards, never further out; it counts as `outside`.

        Raises:
            HardwareError: if a position is not finite.
        """
        if (position := _vector(measured, len(self._names))) is None:
            raise HardwareError(f"measured positions must be {len(self._names)} numbers, got {measured!r}")
        if not np.isfinite(position).all():
            joint = int(np.argmin(np.isfinite(position)))
            place = f"joint {self._names[joint]} is measured at {position[joint]}"
            raise HardwareError(f"{place}, which is not a valid position")
        self._position = position.copy()
        self._step = np.zeros_like(position)
        self._target = self._nothing
        self._target_step = self._nothing
        self._fresh = np.ones(len(position), dtype=bool)
        self._events["outside"] += int(np.count_nonzero((position < self._lower) | (position > self._upper)))
        self._active = True

    def apply(self, desired: object, measured: Vector) -> Vector:
        """Return the commands of one tick [rad], shape (J,), always finite.

        Args:
            desired: positions [rad], a numpy array of shape (J,), or None. A joint brakes and holds if its value is not
                finite or the joint is not measured; all joints do for None, a wrong length or a wrong type.
            measured: positions [rad], shape (J,); NaN where a joint is not measured. While they repeat an older
                reading, the command stays within `max_lead` of it.

        Raises:
            RuntimeError: before the first `activate`.
        """
        if not self._active:
            raise RuntimeError("the safety layer must be activated at the measured positions first")
        wanted = _vector(desired, len(self._names))
        seen = _vector(measured, len(self._names))
        seen = self._nothing if seen is None else seen
        known = np.isfinite(seen)
        lower, upper = self._bounds(seen, known)
        self.overruled = self.guard_fault = ""
        if wanted is None:
            self._events["missing" if desired is None else "wrong_length"] += 1
            command = self._next(self._nothing, np.zeros(len(self._names), dtype=bool), lower, upper)
        else:
            follow = np.zeros_like(known) if self._estopped else np.isfinite(wanted) & known
            before = self._position
            before_step = self._step
            command = limited = self._next(wanted, follow, lower, upper)
            if self._guard is not None and not self._estopped:
                command = self._guarded(self._guard, before, before_step, limited, seen, lower[0], upper[0])
            differs = command != wanted
            if differs.any():
                room = np.where(wanted > before, upper[1] - before, before - lower[1])
                self._count(differs, wanted, known, before, room, command != limited)
            self._fresh &= ~follow
        return command.copy()

    def estop(self) -> None:
        """Latch the emergency stop: every joint brakes at its limit and holds, and desired setpoints are ignored."""
        self._estopped = True

    def reset(self, measured: Vector) -> None:
        """Release the emergency stop and start at rest from the measured positions [rad], shape (J,).

        Raises:
            HardwareError: if a position is not finite; the stop stays latched.
        """
        self.activate(measured)
        self._estopped = False

    @property
    def estopped(self) -> bool:
        """Whether the emergency stop is latched."""
        return self._estopped

    @property
    def current(self) -> Vector:
        """The last command [rad], shape (J,)."""
        return self._position.copy()

    @property
    def velocity(self) -> Vector:
        """The speed of the last command [rad/s], shape (J,)."""
        return self._step / self._period_s

    @property
    def rest(self) -> Vector:
        """Where the joints come to rest if they brake from now on [rad], shape (J,)."""
        left = np.maximum(np.abs(self._step) - self._change, 0.0)
        return self._position + np.copysign(_distance(left, self._change), self._step)

    @property
    def at_rest(self) -> bool:
        """Whether the last command moved no joint, so that a stop is complete."""
        return not self._step.any()

    def limit_speed(self, fraction: float) -> None:
        """Keep to this fraction of the velocity limits from now on.

        Raises:
            HardwareError: if it is lower than before, and the joints move.
        """
        steps = fraction * (self._highest - 2 * self._half_slack) + self._half_slack
        if (steps < self._max_step).any() and not self.at_rest:
            raise HardwareError("the robot moves: wait until it is at rest")
        self._max_step = steps

    def towards(self, target: Vector, speed: float) -> Vector:
        """The desired positions of this tick [rad], shape (J,), for a motion that ends at rest at `target` [rad].

        The motion accelerates, cruises at `speed` (0..1) times the velocity limits, and brakes, within the limits.
        """
        gap = target - self._position
        step = np.copysign(np.minimum(_reach(np.abs(gap), self._change), speed * self._max_step), gap)
        return self._position + _limited(step, self._step - self._change, self._step + self._change)

    def counters(self) -> Mapping[str, int]:
        """Counts since construction: joint-ticks for each of `KINDS`, `outside` joints, refused and missing vectors."""
        return dict(zip(KINDS, self._counts.sum(axis=1).tolist(), strict=True)) | self._events

    @property
    def interventions(self) -> Mapping[str, int]:
        """Joint -> number of ticks in which its setpoint was changed."""
        totals = self._counts.sum(axis=0) + self._events["wrong_length"]
        return dict(zip(self._names, totals.tolist(), strict=True))

    def _bounds(self, seen: Vector, known: NDArray[np.bool_]) -> tuple[Vector, Vector]:
        """Lowest and highest command, and setpoint, of this tick [rad], by position limits and lead; shapes (2, J)."""
        # A joint that started outside its limits may move inwards, and then not back out.
        lower, upper = np.minimum(self._lower, self._position), np.maximum(self._upper, self._position)
        lead = self._leads
        if not known.all():
            seen, lead = np.where(known, seen, 0.0), np.where(known, lead, np.inf)
        return _limited(seen - lead, lower, upper), _limited(seen + lead, lower, upper)

    def _next(self, wanted: Vector, follow: NDArray[np.bool_], lower: Vector, upper: Vector) -> Vector:
        """Advance by a tick towards `wanted` [rad] where `follow`, to a stop elsewhere; shapes (J,), except the bounds.

        The command never leaves the outer bounds. The inner bounds are soft: where `follow`, it brakes towards them.
        """
        slack, low, high = self._half_slack, lower[0], upper[0]
        position = _limited(self._position, low, high)
        left = position != self._position
        if left.any():
            self._step, self._target = np.where(left, 0.0, self._step), np.where(left, np.nan, self._target)
        target = _limited(np.where(follow, wanted, position), low, high)
        ahead = target - position
        # A target that moves smoothly is expected to continue; any other is treated as a place to stop.
        target_step = target - self._target
        smooth = np.abs(target_step - self._target_step) <= self._passed_change
        expected = np.where(smooth, target_step, 0.0)

        slowest = np.maximum(self._step - self._max_change, -self._max_step)
        fastest = np.minimum(self._step + self._max_change, self._max_step)
        if (np.minimum(position - lower[1], upper[1] - position) < self._braking).any():
            room = np.array((position - lower, upper - position))
            reach = np.copysign(_reach(np.abs(room), self._changes), room)
            room_below, below, room_above, above = reach[0, 0], reach[0, 1], reach[1, 0], reach[1, 1]
        else:
            room_below = below = room_above = above = self._highest
        within = (ahead <= np.minimum(fastest + slack, above + self._reach_slack)) & (
            ahead >= np.maximum(slowest - slack, -below - self._reach_slack)
        )
        # Arriving faster than the target moves would overshoot it; a joint already on the target follows it.
        matched = (self._target == position) | (np.abs(ahead - expected) <= self._passed_change)
        passes = follow & within & matched

        if passes.all():
            command = target
        else:
            gap = ahead - expected
            step = _limited(expected + np.copysign(_reach(np.abs(gap), self._change), gap), -below, above)
            step = _limited(np.where(follow, step, 0.0), slowest, fastest)
            # Last, since a position limit must hold even if rounding leaves no step that satisfies all limits.
            step = _limited(step, -room_below, room_above)
            command = np.where(passes, target, _limited(position + step, low, high))
        self._step = command - position
        self._position = command
        self._target = np.where(follow, target, np.nan)
        self._target_step = target_step
        return command

    def _guarded(
        self, guard: Guard, before: Vector, step: Vector, limited: Vector, seen: Vector, low: Vector, high: Vector
    ) -> Vector:
        """The command of the guard [rad], shape (J,): between that of the limits and braking, whatever it returns."""
        accepted = None
        try:
            accepted = _vector(guard.accept(before, step / self._period_s, limited, seen), len(before))
            self.overruled = guard.overruled
        except Exception as error:  # noqa: BLE001 - a plugin's bug must neither end the loop nor let a command through
            self.guard_fault = f"control.guard fails: {type(error).__name__}: {error}"
        if accepted is None or not np.array_equal(accepted, limited):
            brakes = before + _limited(np.zeros_like(step), step - self._change, step + self._change)
            usable = brakes if accepted is None else np.where(np.isfinite(accepted), accepted, brakes)
            self._position = _limited(
                _limited(usable, np.minimum(brakes, limited), np.maximum(brakes, limited)), low, high
            )
            self._step = self._step + (self._position - limited)
            self._target = np.where(self._position == limited, self._target, np.nan)
        return self._position

    def _count(
        self, differs: NDArray[np.bool_], wanted: Vector, known: NDArray[np.bool_], before: Vector, room: Vector,
        guarded: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Count the joints marked in `differs`, each under the first of `KINDS` that applies.

        Args:
            differs: shape (J,).
            wanted: shape (J,).
            known: whether each joint is measured, shape (J,).
            before: the last commands, shape (J,).
            room: the way to the last setpoint that the lead allows in the direction of `wanted` [rad], shape (J,).
            guarded: which the guard has changed, shape (J,).
        """
        lower, upper = np.minimum(self._lower, before), np.maximum(self._upper, before)
        step = _limited(wanted, lower, upper) - before
        # The lead limits a joint as soon as braking for it begins.
        leads = (np.abs(wanted - before) > room) & (room < self._braking)
        reasons = np.array([
            differs & self._estopped, ~np.isfinite(wanted), ~known, self._fresh, (wanted < lower) | (wanted > upper),
            leads, guarded, np.abs(step) > self._max_step + self._half_slack, differs,
        ])  # fmt: skip
        joints = np.flatnonzero(differs)
        self._counts[reasons.argmax(axis=0)[joints], joints] += 1


def _vector(value: object, size: int) -> Vector | None:
    """`value` as float64 if it is an array of `size` real numbers, else None."""
    if isinstance(value, np.ndarray) and value.shape == (size,) and value.dtype.kind in "fiu" and value.itemsize <= 8:
        return value.astype(np.float64, copy=False)
    return None


def _limited(value: Vector, lower: Vector, upper: Vector) -> Vector:
    """Clip `value` to `lower` and `upper`; np.clip takes twice as long for a few joints."""
    result: Vector = np.minimum(np.maximum(value, lower), upper)
    return result


def _reach(distance: Vector, change: Vector) -> Vector:
    """The largest step from which braking by `change` per tick ends within `distance`; shapes (..., J).

    A step u, then u - D, u - 2 D, … while positive, covers (n + 1) u - D n (n + 1) / 2 with n = floor(u / D).
    """
    n = np.floor((np.sqrt(1.0 + 8.0 * distance / change) - 1.0) / 2.0)
    return distance / (n + 1.0) + n * change / 2.0


def _distance(step: Vector, change: Vector) -> Vector:
    """The way of `step` and of braking from it by `change` per tick, the inverse of `_reach`; shapes (J,)."""
    n = np.floor(step / change)
    return (n + 1.0) * (step - n * change / 2.0)
