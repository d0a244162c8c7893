"""Servo: moves the tool along a stream of twists, smoothly and within the limits of the joints.

For all devices that jog a tool: keyboards, gamepads, 3D mice, phones, and topics of twists.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from enum import IntEnum

import attrs
import numpy as np

from ibrobot_core.api import Vector, ns, seconds
from ibrobot_kinematics.constraints import ToolConstraints
from ibrobot_kinematics.model import KinematicModel, TipPose
from ibrobot_kinematics.servo_options import ServoOptions

_LEVER_M = 0.1
"""Length that corresponds to a turn of one radian [m]."""
_DAMPING = 1e-7
_MISSED_SLOW, _MISSED_HALT = 0.25, 0.5
"""Shares of a twist that the tip may miss before it slows down, and before it stops, at the edge of its reach."""
_LOOK_AHEAD_S = 0.05
"""How far ahead the arm checks whether it approaches or leaves a singularity or an obstacle."""
_LEAVING = 0.1
"""Least share of the speed at which an arm leaves a singularity."""
_AT_REST = 1e-6
"""Joint speeds below this [rad/s or m/s] count as rest."""
_LONGEST_TICK_S = 0.1
"""A longer gap between steps counts as a stop, and is not caught up."""
_VELOCITY, _ACCELERATION = 0.95, 0.85
"""Shares of the joints' limits that are used. The times of the steps jitter, and a setpoint beyond a limit would lag
behind and then overshoot."""
_APPROACH_S = 0.15
"""Least time constant with which the tool approaches the bound of a path constraint [s]."""
_BRAKING = 1.5
"""The same, as a multiple of the time in which the joints stop."""
_STOPPING = np.array([0.33, 0.67, 1.0])
"""Parts of the way to a stop at which constraints are checked."""
_RESERVE = 0.25
"""Share of a constraint's `insides` that stays free at a stop, for the jitter of the steps."""
_BOUND_WEIGHT = 1e4
"""Weight of the bound of a constraint, against that of the twist."""
_DEFAULTS = ServoOptions()


class ServoStatus(IntEnum):
    """What limits the tool, with the codes of MoveIt Servo (moveit_servo/status_codes.h, ROS 2 Humble)."""

    INVALID = -1
    """The last twist was refused."""
    NO_WARNING = 0
    DECELERATE_FOR_APPROACHING_SINGULARITY = 1
    HALT_FOR_SINGULARITY = 2
    DECELERATE_FOR_COLLISION = 3
    HALT_FOR_COLLISION = 4
    JOINT_BOUND = 5
    """A joint is near its limit, or the tool at the edge of its reach, or at the bound of a path constraint."""
    DECELERATE_FOR_LEAVING_SINGULARITY = 6


@attrs.frozen(eq=False)
class _Twist:
    linear: Vector
    angular: Vector
    in_tool: bool
    until_ns: int


class Servo:
    """Joint positions that follow twists of the tool, tick by tick.

    The tip follows the newest twist as well as the arm can. If it cannot, e.g. at the edge of its reach, it slows down
    and stops. Positions, speeds and accelerations of joints stay within their limits; a joint beyond its limit only
    moves inwards. Without a new twist in time, the arm slows down to a stop. The caller passes the time to each step.
    Near the bound of a path constraint, the tool slows down towards it, and slides along; beyond it, it only moves
    back.

    Args:
        model: the arm.
        max_velocity: highest speed of each joint [rad/s or m/s], shape (J,).
        max_acceleration: highest acceleration of each joint [rad/s² or m/s²], shape (J,).
        options: limits of twists, and when to slow down and stop.
        clearance: joint positions, shape (J,) -> distance to the nearest obstacle [m]; None without obstacles.
        turn_weights: weights of turns about the tip's own x, y and z axes, shape (3,). By default an arm with five
            joints, which cannot control all of them, gives way about the tip's x axis: the heading of a tool that
            points along z.

    Attributes:
        position: joint positions [rad or m], shape (J,).
        velocity: joint velocities [rad/s or m/s], shape (J,).
        refused: reason -> number of twists refused for it.
    """

    def __init__(
        self,
        model: KinematicModel,
        max_velocity: Vector,
        max_acceleration: Vector,
        options: ServoOptions = _DEFAULTS,
        *,
        clearance: Callable[[Vector], float] | None = None,
        turn_weights: Sequence[float] = (0.05, 1.0, 1.0),
    ) -> None:
        joints = model.lower.shape
        for name, limits in (("max_velocity", max_velocity), ("max_acceleration", max_acceleration)):
            if np.shape(limits) != joints or not (np.isfinite(limits) & (np.asarray(limits) > 0)).all():
                raise ValueError(f"{name} must be above 0 with shape {joints}, got {np.asarray(limits).tolist()}")
        self._model = model
        self._options = options
        self._clearance = clearance
        self._max_velocity = _VELOCITY * max_velocity[model.moving]
        self._max_acceleration = _ACCELERATION * max_acceleration[model.moving]
        # From full speed, a joint stops within the margin, unless its acceleration is too low.
        braking = self._max_velocity**2 / (2 * options.joint_limit_margin)
        self._braking = np.minimum(braking, self._max_acceleration)
        stopping = float((self._max_velocity / self._max_acceleration).max(initial=0.0))
        self._approach_s = max(_APPROACH_S, _BRAKING * stopping)
        given, middle = options.path_constraints, (model.lower + model.upper) / 2
        self._constraints = None if given is None else ToolConstraints(given, model, middle)
        self._overruled: Vector | None = None
        """The twist, weighted, along which not all joints could go as asked; None if they could."""
        self._weights = np.concatenate([np.ones(3), _LEVER_M * np.asarray(turn_weights, dtype=float)])
        self.refused: Counter[str] = Counter()
        self.reset(middle)

    def reset(self, position: Vector) -> None:
        """Rest at a position, and drop the twist.

        Args:
            position: joint positions [rad or m], shape (J,).

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        if np.shape(position) != self._model.lower.shape or not np.isfinite(position).all():
            raise ValueError(
                f"position must be finite with shape {self._model.lower.shape}, got {np.asarray(position).tolist()}"
            )
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros_like(self.position)
        self._overruled = None
        self._state = ServoStatus.NO_WARNING
        self._is_invalid = False
        self._twist: _Twist | None = None
        self._last_ns: int | None = None

    @property
    def status(self) -> ServoStatus:
        """What limits the tool."""
        return ServoStatus.INVALID if self._is_invalid else self._state

    @property
    def at_rest(self) -> bool:
        """Whether no joint moves, and there is no twist."""
        return self._twist is None and not np.abs(self.velocity).max() > _AT_REST

    def tip(self) -> TipPose:
        """Pose of the tip in the base frame."""
        return self._model.forward(self.position)

    def command(self, linear: Vector, angular: Vector, now_ns: int, *, in_tool: bool = False) -> str | None:
        """Follow a twist from now on, until the timeout.

        Args:
            linear: velocity of the tip's origin [m/s], shape (3,).
            angular: angular velocity of the tip [rad/s], shape (3,).
            now_ns: the time [ns].
            in_tool: whether both are along the axes of the tip, rather than those of the base frame.

        Returns:
            Why it was refused, in which case the previous twist stays; None if it was accepted.
        """
        reason = self._fault(np.asarray(linear), np.asarray(angular))
        if reason is not None:
            self.refuse(reason)
            return reason
        until = now_ns + ns(self._options.timeout)
        self._twist = _Twist(np.array(linear, dtype=float), np.array(angular, dtype=float), in_tool, until)
        self._is_invalid = False
        return None

    def refuse(self, reason: str) -> None:
        """Count a twist that was refused."""
        self.refused[reason] += 1
        self._is_invalid = True

    def hold_at(self, position: Vector) -> None:
        """Rest at a position [rad or m], shape (J,), e.g. if a joint does not follow; the twist stays."""
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros_like(self.position)

    def overruled(self, position: Vector) -> None:
        """Rest at the commanded position [rad or m], shape (J,), which is not what was asked for.

        What keeps a robot from collisions may let some joints go on, and others not. Along such a twist, the arm then
        moves only so that any part of its joints keeps the path constraints.
        """
        self.hold_at(position)
        if self._twist is not None:
            self._overruled = self._requested(self._twist, self._model.forward(position))

    def stop_position(self) -> Vector:
        """Where the arm stops if it brakes from now on [rad or m], shape (J,)."""
        moving = self._model.moving
        velocity, stop = self.velocity[moving], self.position.copy()
        stop[moving] += velocity * float(np.max(np.abs(velocity) / self._max_acceleration)) / 2
        return stop

    def halt(self) -> None:
        """Drop the twist: the arm slows down to a stop."""
        self._twist = None

    def step(self, now_ns: int, *, waits: bool = False) -> Vector:
        """Joint positions at a time, shape (J,).

        Args:
            now_ns: the time [ns]; if it has not advanced, nothing moves.
            waits: whether the arm brakes on its way, although there is a twist.
        """
        last, self._last_ns = self._last_ns, now_ns
        if self._twist is not None and now_ns >= self._twist.until_ns:
            self._twist = None
        if last is None or now_ns <= last:
            return self.position.copy()
        dt = seconds(now_ns - last)
        if dt > _LONGEST_TICK_S:
            self.velocity = np.zeros_like(self.position)
            return self.position.copy()
        moving = self._model.moving
        lowest, highest = self._bounds(dt)
        wanted = np.zeros(len(moving))
        if self._twist is not None and not waits:
            wanted = self._joint_speeds(self._twist, np.minimum(lowest, 0), np.maximum(highest, 0))
        else:
            self._state = ServoStatus.NO_WARNING
        # Scale the changes of all speeds alike, so that the twist changes in a straight line.
        before = self.velocity[moving]
        change, most = wanted - before, self._max_acceleration * dt
        share = min(1.0, float(np.min(most / np.maximum(np.abs(change), 1e-12))))
        after = np.clip(before + share * change, lowest, highest)
        after = np.clip(after, before - most, before + most)
        if waits or (self._constraints is not None and not self._stops_within(self._constraints, after, dt)):
            after = before - before * min(1.0, float(np.min(most / np.maximum(np.abs(before), 1e-12))))
            self._state = ServoStatus.JOINT_BOUND
        self.velocity[moving] = after
        self.position[moving] += after * dt
        return self.position.copy()

    def _fault(self, linear: Vector, angular: Vector) -> str | None:
        if linear.shape != (3,) or angular.shape != (3,):
            return "not three numbers each"
        if not (np.isfinite(linear).all() and np.isfinite(angular).all()):
            return "not finite"
        if math.hypot(*linear) > self._options.max_linear:
            return f"faster than {self._options.max_linear:g} m/s"
        if math.hypot(*angular) > self._options.max_angular:
            return f"turns faster than {self._options.max_angular:g} rad/s"
        return None

    def _bounds(self, dt: float) -> tuple[Vector, Vector]:
        """Speeds from which each joint can still stop at its limit; beyond it, only inward speeds."""
        moving = self._model.moving
        here, drop = self.position[moving], self._braking * dt

        def stoppable(room: Vector) -> Vector:
            # After this tick at speed v, the remaining room - v dt suffices to stop.
            return np.asarray(np.sqrt(drop**2 + 2 * self._braking * np.maximum(room, 0.0)) - drop)

        highest = np.minimum(stoppable(self._model.upper[moving] - here), self._max_velocity)
        lowest = -np.minimum(stoppable(here - self._model.lower[moving]), self._max_velocity)
        return lowest, highest

    def _joint_speeds(self, twist: _Twist, lowest: Vector, highest: Vector) -> Vector:
        """Joint speeds that follow a twist, scaled down if necessary; sets the status."""
        model = self._model
        moving = model.moving
        tip, jacobian = model.forward_and_jacobian(self.position)
        to_tip = tip.rotation.T
        # Turns are in the frame of the tip, where their weights are.
        rates = self._weights[:, None] * np.vstack([jacobian[:3, moving], to_tip @ jacobian[3:, moving]])
        requested = self._requested(twist, tip)
        self._state = ServoStatus.NO_WARNING
        if self._overruled is not None and requested @ self._overruled <= 0:
            self._overruled = None  # away from what held it back
        size = float(np.linalg.norm(requested))
        if size == 0:
            return np.zeros(len(moving))
        hessian, gradient = rates.T @ rates + _DAMPING * np.eye(len(moving)), -rates.T @ requested
        # A twist that is too fast for a joint is slowed down in the same direction.
        excess = float(np.max(np.abs(np.linalg.solve(hessian, gradient)) / self._max_velocity))
        slower = 1 / max(excess, 1.0)
        wanted = bounded_minimum(hessian, slower * gradient, lowest, highest)
        missed = float(np.linalg.norm(rates @ wanted - slower * requested)) / (slower * size)
        scale = float(np.clip((_MISSED_HALT - missed) / (_MISSED_HALT - _MISSED_SLOW), 0, 1))
        near_limit = (wanted <= lowest) & (lowest > -self._max_velocity)
        near_limit |= (wanted >= highest) & (highest < self._max_velocity)
        if scale < 1 or near_limit.any():
            self._state = ServoStatus.JOINT_BOUND
        if self._constraints is not None:
            wanted = self._constrained(self._constraints, wanted, hessian, slower * gradient, lowest, highest)
        ahead = self.position.copy()
        ahead[moving] += wanted * _LOOK_AHEAD_S
        scale *= self._scale_for_singularity(jacobian, ahead)
        if self._clearance is not None:
            scale *= self._scale_for_obstacles(self._clearance, ahead)
        return scale * wanted

    def _constrained(
        self, constraints: ToolConstraints, wanted: Vector, hessian: Vector, gradient: Vector, lowest: Vector,
        highest: Vector,
    ) -> Vector:  # fmt: skip
        """Joint speeds near the wanted ones that approach no constraint faster than the room to its bound allows."""
        excess, rates = constraints.excess_and_rates(self.position)
        most = np.maximum(-(excess + constraints.insides), 0.0) / self._approach_s
        held = np.zeros(len(most), dtype=bool)
        while True:
            over = np.where(held, 0.0, rates @ wanted - most)
            if not over.max() > _AT_REST:
                break
            self._state = ServoStatus.JOINT_BOUND
            held[int(over.argmax())] = True
            rows = rates[held]
            wanted = bounded_minimum(
                hessian + _BOUND_WEIGHT * rows.T @ rows, gradient - _BOUND_WEIGHT * most[held] @ rows, lowest, highest
            )
        # What remains for a bound is little, and scaling all speeds alike keeps all other bounds.
        towards = rates @ wanted
        if self._overruled is not None:
            # Of the joints, any part may stand still.
            towards = np.maximum(rates * wanted, 0.0).sum(axis=1)
            if (towards > most).any():
                self._state = ServoStatus.JOINT_BOUND
        return wanted * float(np.min(np.where(towards > most, most / np.maximum(towards, 1e-12), 1.0)))

    def _requested(self, twist: _Twist, tip: TipPose) -> Vector:
        """The twist, linear in the base frame and angular in that of the tip, weighted, shape (6,)."""
        if twist.in_tool:
            return np.asarray(self._weights * np.concatenate([tip.rotation @ twist.linear, twist.angular]))
        return np.asarray(self._weights * np.concatenate([twist.linear, tip.rotation.T @ twist.angular]))

    def _stops_within(self, constraints: ToolConstraints, velocity: Vector, dt: float) -> bool:
        """Whether the arm, if it brakes after a tick at a velocity [rad/s], shape (n,), stops within bounds and limits.

        The way to the stop is straight, since all joints brake in proportion. An arm that brakes stays on the way that
        this check accepted a tick before.
        """
        stopping = dt + float(np.max(np.abs(velocity) / self._max_acceleration)) / 2
        way = np.repeat(self.position[None], len(_STOPPING) + 1, axis=0)
        way[1:, self._model.moving] += np.multiply.outer(_STOPPING * (dt + stopping), velocity)
        model, begin, end = self._model, way[0], way[-1]
        if ((end < np.minimum(model.lower, begin)) | (end > np.maximum(model.upper, begin))).any():
            return False  # a joint that brakes in proportion to the others brakes less than it could
        here, *ahead = constraints.excess(way)
        return bool((ahead <= np.maximum(here, -_RESERVE * constraints.insides)).all())

    def _scale_for_singularity(self, jacobian: Vector, ahead: Vector) -> float:
        options = self._options
        condition = self._condition(jacobian)
        if condition <= options.lower_singularity_threshold:
            return 1.0
        way = options.hard_stop_singularity_threshold - options.lower_singularity_threshold
        scale = float(np.clip((options.hard_stop_singularity_threshold - condition) / way, 0, 1))
        if self._condition(self._model.jacobian(ahead)) < condition:
            self._state = ServoStatus.DECELERATE_FOR_LEAVING_SINGULARITY
            return max(scale, _LEAVING)
        halts = scale == 0
        self._state = ServoStatus.HALT_FOR_SINGULARITY if halts else ServoStatus.DECELERATE_FOR_APPROACHING_SINGULARITY
        return scale

    def _condition(self, jacobian: Vector) -> float:
        levers = np.array([1.0] * 3 + [_LEVER_M] * 3)
        values = np.linalg.svd(levers[:, None] * jacobian[:, self._model.moving], compute_uv=False)
        return float(values[0] / max(values[-1], 1e-12))

    def _scale_for_obstacles(self, clearance: Callable[[Vector], float], ahead: Vector) -> float:
        options = self._options
        distance = clearance(self.position)
        if distance >= options.slow_distance or clearance(ahead) > distance:
            return 1.0
        way = options.slow_distance - options.stop_distance
        scale = float(np.clip((distance - options.stop_distance) / way, 0, 1))
        self._state = ServoStatus.HALT_FOR_COLLISION if scale == 0 else ServoStatus.DECELERATE_FOR_COLLISION
        return scale


def bounded_minimum(hessian: Vector, gradient: Vector, lower: Vector, upper: Vector) -> Vector:
    """The x that minimises `x @ hessian @ x / 2 + gradient @ x` between `lower` and `upper`, by an active set.

    Args:
        hessian: positive definite, shape (N, N).
        gradient: shape (N,).
        lower: at most 0, shape (N,).
        upper: at least 0, shape (N,).
    """
    x = np.linalg.solve(hessian, -gradient)
    if (x >= lower).all() and (x <= upper).all():
        return x
    x = np.zeros_like(gradient)
    held = np.zeros(len(x), dtype=bool)
    tolerance = 1e-12 * (1 + np.abs(gradient).max())
    # Each round fixes or releases one entry. Rounding could cause cycles, so the number of rounds is bounded.
    for _ in range(10 * len(x)):
        free = ~held
        step = np.zeros_like(x)
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], -(hessian @ x + gradient)[free])
        room = np.where(step > 0, upper - x, lower - x)
        share = np.full_like(x, np.inf)
        np.divide(room, step, out=share, where=step != 0)
        first = int(np.argmin(share))
        if share[first] < 1:
            x += share[first] * step
            x[first] = upper[first] if step[first] > 0 else lower[first]
            held[first] = True
            continue
        x += step
        slope = hessian @ x + gradient
        # The gain from moving a fixed entry back inwards.
        gain = np.where(held & (lower < upper), np.where(x <= lower, -slope, slope), 0.0)
        first = int(np.argmax(gain))
        if gain[first] <= tolerance:
            break
        held[first] = False
    return np.clip(x, lower, upper)
