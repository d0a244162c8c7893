"""Teleop `cmd_vel`: drives a base by a topic of twists."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_core.api import (
    Context,
    Header,
    JointReading,
    Message,
    Teleop,
    TeleopCommand,
    TeleopError,
    Twist,
    TwistStamped,
    Vector,
    ns,
    seconds,
)
from ibrobot_core.app import Subscription
from ibrobot_lerobot_devices.options import CmdVelOptions

_LONGEST_STEP_S = 0.1
"""Longest time step, e.g. after a pause of the host [s]."""
_PAUSE_NS = ns(0.5)
"""A stream of twists that was silent for so long counts as released [ns]."""
_SOON_NS = ns(0.25)
"""Time after the beginning of the mode in which a stream shows that it goes on [ns]."""

_LEAST_PACE = 0.1
"""Share of the wanted velocity at which the setpoint leaves a base behind that does not move."""


class CmdVelTeleop(Teleop):
    """The newest twist drives the base along its own axes, within the limits of the joints that are the axes.

    Twists other than zero count as a pressed deadman, a zero twist or a pause of 0.5 s as its release: a stream that
    goes on over a reset, a mode switch or a gap moves nothing before. Without another twist the base stands after
    0.3 s, braking included. Arrays have one element for each axis, shape (B,).
    """

    def __init__(self, options: CmdVelOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        fields = {"linear.x": options.x, "linear.y": options.y, "angular.z": options.theta}
        self._axes = {joint: field for field, joint in fields.items() if joint in ctx.robot.joint_names}
        """Joint -> the field of a twist that drives it."""
        self._joints = tuple(self._axes)
        self._columns = ctx.robot.indices(self._joints)
        self._twists: Subscription | None = None
        self._refused = 0
        self._wanted: Vector = np.zeros(len(self._joints))
        """The newest twist [m/s, rad/s]."""
        self._velocity: Vector = np.zeros(len(self._joints))
        """Velocity of the setpoint, if the base keeps up [m/s, rad/s]."""
        self._pace = 1.0
        """Share of that velocity at which the setpoint moves, for a base that is behind."""
        self._setpoint: Vector | None = None
        """[m, rad]; None while the base stands."""
        self._set_ns = self._quiet_since_ns = 0

    @override
    def connect(self) -> None:
        ctx = self._ctx
        if ctx.bus is None:
            raise TeleopError(f"{ctx.name}: twists come over the bus, which this process does not have")
        if not self._axes:
            wanted = ", ".join((self._options.x, self._options.y, self._options.theta))
            raise TeleopError(f"{ctx.name}: the robot has none of the joints {wanted}: give those of its base")
        self._twists = ctx.bus.subscribe(self._options.topic, 10, Twist, TwistStamped)

    @override
    def activate(self, measured: JointReading) -> None:
        came = bool(self._twists.drain()) if self._twists is not None else False  # discards earlier twists
        # While the device was closed, a stream may have gone on: then the next twist comes soon.
        self._quiet_since_ns = measured.stamp_ns - (0 if came else _PAUSE_NS - _SOON_NS)
        self._stop()

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if self._twists is None:
            raise TeleopError(f"{self._ctx.name}: twists are not connected: connect comes before read")
        now_ns = measured.stamp_ns
        if now_ns - self._quiet_since_ns >= _PAUSE_NS:
            self.deadman.report(False, now_ns)
        for received in self._twists.drain():
            self._quiet_since_ns = now_ns
            if (twist := self._taken(received.message)) is not None:
                self._wanted = twist
                self.deadman.report(bool(twist.any()), now_ns)
        wanted = self._wanted if self.deadman.allows(now_ns) else np.zeros_like(self._wanted)
        return self._step(measured, wanted)

    @override
    def disconnect(self) -> None:
        if self._twists is not None:
            self._twists.close()
        self._twists = None

    @override
    def help(self) -> str:
        fields = ", ".join(self._axes.values())
        return f"publish geometry_msgs/msg/Twist or TwistStamped on {self._options.topic}, with {fields}"

    def _step(self, measured: JointReading, wanted: Vector) -> TeleopCommand:
        """The next setpoint, at a velocity that approaches the one wanted [m/s, rad/s]."""
        robot, here = self._ctx.robot, measured.position[self._columns]
        fastest, acceleration = robot.max_velocity[self._columns], robot.max_acceleration[self._columns]
        # A twist that is too fast keeps its direction.
        wanted = wanted * min(1.0, float(np.min(fastest / np.maximum(np.abs(wanted), 1e-9))))
        if self._setpoint is None:
            if not wanted.any():
                return TeleopCommand(None)
            self._setpoint, self._set_ns = here.copy(), measured.stamp_ns
        elapsed_s = min(seconds(measured.stamp_ns - self._set_ns), _LONGEST_STEP_S)
        change = acceleration * elapsed_s
        if brakes := not wanted.any():
            self._velocity = self._pace * self._velocity  # as fast as it really was
        self._velocity = self._velocity + np.clip(wanted - self._velocity, -change, change)
        # A base that falls behind is waited for, along all axes, so that the twist keeps its direction.
        lead = robot.max_lead[self._columns] / 4
        behind = np.sign(self._velocity) * (self._setpoint - here)
        self._pace = 1.0 if brakes else float(np.clip(2.0 * np.min(1.0 - behind / lead), _LEAST_PACE, 1.0))
        self._setpoint = self._setpoint + self._pace * self._velocity * elapsed_s
        if (np.abs(self._setpoint - here) > 1.5 * lead).any():  # something holds it: it starts again from where it is
            self._setpoint, self._velocity = here.copy(), np.zeros_like(here)
        self._set_ns = measured.stamp_ns
        command = TeleopCommand(dict(zip(self._joints, self._setpoint.tolist(), strict=True)))
        if not wanted.any() and not self._velocity.any():
            self._stop()
        return command

    def _stop(self) -> None:
        self._pace = 1.0
        self._wanted, self._velocity, self._setpoint = np.zeros(len(self._joints)), np.zeros(len(self._joints)), None

    def _taken(self, message: Message) -> Vector | None:
        """The velocities of a message [m/s, rad/s], or None if it is refused."""
        twist = message.twist if isinstance(message, TwistStamped) else message
        assert isinstance(twist, Twist)
        header = message.header if isinstance(message, TwistStamped) else Header(0)
        linear, angular = twist.linear, twist.angular
        given = {
            "linear.x": linear.x, "linear.y": linear.y, "linear.z": linear.z,
            "angular.x": angular.x, "angular.y": angular.y, "angular.z": angular.z,
        }  # fmt: skip
        if header.frame_id not in ("", self._options.frame):
            why = f"its frame is {header.frame_id!r}, not {self._options.frame!r}"
        elif refusal := self._ctx.clock.refusal(header.stamp_ns):
            why = refusal
        elif not np.isfinite(list(given.values())).all():
            why = "it is not finite"
        elif strange := [field for field, value in given.items() if value and field not in self._axes.values()]:
            why = f"the base has no axis for {', '.join(strange)}"
        else:
            return np.array([given[field] for field in self._axes.values()])
        self._refused += 1
        if self._refused == 1:
            self._ctx.log.warning("%s: refused a twist: %s; further ones are not reported", self._ctx.name, why)
        return None
