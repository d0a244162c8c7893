"""Smooth handover of an arm from one command source to another."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ibrobot_core.api import Vector, ns, seconds
from ibrobot_core.app import ControlState, StreamingRun

_BRAKE_SHARE, _FADE_SHARE = 0.75, 0.5
"""Fraction of the limits used for braking, and for moving to the positions of a device."""
_SHORTEST_S = 0.02


class Handover:
    """Brakes the joints of a mode to a stop, holds them, and blends into the positions of an operator's devices.

    All arrays have one element per joint, shape (J,), in robot order.

    Args:
        session: the run.
        joints: the joints of the mode's executors, in robot order.
    """

    def __init__(self, session: StreamingRun, joints: tuple[str, ...]) -> None:
        robot = session.config.robot
        self._session = session
        self._joints = joints
        self._columns = robot.indices(joints)
        self._lower, self._upper = robot.lower[self._columns], robot.upper[self._columns]
        self._max_velocity = robot.max_velocity[self._columns]
        self._max_acceleration = robot.max_acceleration[self._columns]
        self.begin()

    def begin(self) -> None:
        """Forget all states, since another source commands the joints."""
        self._seen_ns = 0
        self._command = self._velocity = np.zeros(len(self._joints))
        """The last command [rad] and its velocity [rad/s]."""
        self._sent = self._command
        """The positions sent last [rad]."""
        self.holds = False
        """Whether the joints brake or hold."""
        self._rest_ns = 0
        """When braking ends [ns]."""
        self._gap, self._fade_ns, self._fade_s = self._command, 0, 1.0
        """Offset from the devices' positions that fades out [rad], start of the fade [ns], and its duration [s]."""

    def see(self, state: ControlState) -> None:
        """Take in a new state of control."""
        command = state.command[self._columns]
        if 0 < state.stamp_ns - self._seen_ns < ns(0.1):
            self._velocity = (command - self._command) / seconds(state.stamp_ns - self._seen_ns)
        else:
            self._velocity = np.zeros(len(self._joints))
        self._command, self._seen_ns = command, state.stamp_ns

    @property
    def at_rest(self) -> bool:
        """Whether the joints hold after braking."""
        return self.holds and self._seen_ns >= self._rest_ns

    @property
    def position(self) -> Vector:
        """The positions sent last for all joints of the robot [rad], shape (robot's J,)."""
        state = self._session.state
        assert state is not None
        every = state.command.copy()
        every[self._columns] = self._sent
        return every

    def brake(self) -> None:
        """Brake to a stop along `v (1 - s)^2`; `hold` continues from there."""
        speed = np.abs(self._velocity)
        brake_s = max(_SHORTEST_S, float((2 * speed / (_BRAKE_SHARE * self._max_acceleration)).max()))
        stop = self._command + self._velocity * brake_s / 3
        self._sent = np.clip(stop, np.minimum(self._lower, self._command), np.maximum(self._upper, self._command))
        # The plan begins at the last state, so that the executor joins it at its present position and velocity.
        self._send(self._seen_ns, brake_s, np.array((self._sent, self._sent)))
        # The executor reads the plan up to two periods later.
        self.holds, self._rest_ns = True, self._seen_ns + ns(brake_s + 2 / self._session.config.control.rate_hz)

    def hold(self, for_s: float = 0.0) -> None:
        """Hold the position of rest, for `for_s` [s] unless called again; does nothing while braking."""
        if self.at_rest:
            self._send(self._seen_ns, for_s, np.array((self._sent, self._sent)[: 1 + (for_s > 0)]))

    def follow(self, positions: Mapping[str, float]) -> None:
        """Follow an operator. The offset between the held position and the first of these fades out along a cubic.

        Args:
            positions: joint -> position [rad]; other joints hold.
        """
        wanted = self._sent.copy()
        for i, joint in enumerate(self._joints):
            wanted[i] = positions.get(joint, wanted[i])
        if self.holds:
            self.holds = False
            self._gap, self._fade_ns = self._sent - wanted, self._seen_ns
            way = np.abs(self._gap)
            by_velocity = 1.5 * way / (_FADE_SHARE * self._max_velocity)
            by_acceleration = np.sqrt(6 * way / (_FADE_SHARE * self._max_acceleration))
            self._fade_s = max(_SHORTEST_S, float(by_velocity.max()), float(by_acceleration.max()))
        s = min(1.0, seconds(self._seen_ns - self._fade_ns) / self._fade_s)
        moved = np.array([joint in positions for joint in self._joints])
        self._sent = np.where(moved, wanted + (1 - s**2 * (3 - 2 * s)) * self._gap, wanted)
        self._send(self._session.clock.now_ns(), 0.0, self._sent[None])

    def _send(self, start_ns: int, step_s: float, positions: Vector) -> None:
        self._session.send_plan(start_ns, max(1, math.ceil(step_s * 1e9)), self._joints, positions)
