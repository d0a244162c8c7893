"""Teleop `replay`: moves to a joint log's first sample, then plays the log by time."""

from __future__ import annotations

import queue
from typing import override

import numpy as np

from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import Context, JointReading, Teleop, TeleopCommand
from ibrobot_core.robot import Vector
from ibrobot_core.units import seconds
from ibrobot_jointlog.log import JointLog, read_log
from ibrobot_jointlog.options import ReplayOptions


class ReplayTeleop(Teleop):
    """Plays a joint log from wherever the robot is, once the operator presses space.

    Where there is no terminal, nobody can press it: it plays as soon as its mode begins.

    A run has two parts: the approach, from the position measured when it starts to the log's first sample, and the
    log itself. A looping replay approaches its first sample again from the last.
    """

    def __init__(self, options: ReplayOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self._robot = ctx.robot
        self._keys: queue.SimpleQueue[str] | None = None
        self._log: JointLog | None = None
        self._begun_ns: int | None = None
        """When the present run began [ns]; None until it is started."""
        self._from: Vector = np.empty(0)
        """Where it began [rad], shape (J,)."""

    @override
    def connect(self) -> None:
        self._log = read_log(self._options.path, self._robot.joint_names)
        self._begun_ns = None
        self._keys = self._ctx.keys() if self._ctx.keys is not None else None

    @override
    def activate(self, measured: JointReading) -> None:
        self._begun_ns = None
        self._typed()  # what was typed for something else

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        log = self._log
        if log is None:
            raise TeleopError("replay is not connected: connect comes before read")
        if self._begun_ns is None:
            if self._keys is not None and _START_KEY not in self._typed():
                return TeleopCommand(None)
            self._begun_ns, self._from = measured.stamp_ns, measured.position.copy()
        elapsed = seconds(measured.stamp_ns - self._begun_ns)
        approach = self._approach_time(log.positions[0] - self._from)
        played = (elapsed - approach) * self._options.speed
        if played < 0:
            return self._command(self._from + _ease(elapsed / approach) * (log.positions[0] - self._from))
        if played < log.times[-1] - log.times[0]:
            at = log.times[0] + played
            return self._command(np.array([np.interp(at, log.times, column) for column in log.positions.T]))
        if self._options.loop:
            self._begun_ns, self._from = measured.stamp_ns, log.positions[-1].copy()
        return self._command(log.positions[-1], finished=not self._options.loop)

    @override
    def disconnect(self) -> None:
        self._log = self._keys = None

    @override
    def help(self) -> str:
        again = ", again and again" if self._options.loop else ""
        waits = self._keys is not None and self._begun_ns is None
        return f"press {_START_KEY} to replay {self._options.path}" if waits else f"replays {self._options.path}{again}"

    def _typed(self) -> list[str]:
        typed: list[str] = []
        while self._keys is not None and not self._keys.empty():
            typed.append(self._keys.get_nowait())
        return typed

    def _command(self, positions: Vector, finished: bool = False) -> TeleopCommand:
        named = dict(zip(self._robot.joint_names, positions.tolist(), strict=True))
        return TeleopCommand(named, finished=finished)

    def _approach_time(self, delta: Vector) -> float:
        """The time [s] in which `delta` [rad], shape (J,), is eased through within speed and half the acceleration."""
        distance = np.abs(delta)
        speed = np.minimum(self._options.approach_speed, self._robot.max_velocity)
        by_speed = _PEAK_SPEED * distance / speed
        by_acceleration = np.sqrt(_PEAK_ACCELERATION * distance / (0.5 * self._robot.max_acceleration))
        return float(np.max(np.maximum(by_speed, by_acceleration)))


_START_KEY = "space"
_PEAK_SPEED, _PEAK_ACCELERATION = 1.5, 6.0
"""Greatest first and second derivative of `_ease`."""


def _ease(share: float) -> float:
    """From 0 to 1, at rest at both ends."""
    return share * share * (3 - 2 * share)
