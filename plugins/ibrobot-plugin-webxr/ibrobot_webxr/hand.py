"""The motion of one hand while the clutch is held: filtered, and at rest where the hand is at rest."""

from __future__ import annotations

import math

import numpy as np
from ibrobot_kinematics.rotations import exp, from_quaternion, log

from ibrobot_core.api import Vector
from ibrobot_webxr.messages import HandPose
from ibrobot_webxr.one_euro import PoseFilter
from ibrobot_webxr.options import WebxrOptions

_TO_ROBOT = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation from WebXR's axes (right, up, back) to the robot's (forward, left, up)."""
_REST_S = 0.5
"""A hand that stays within the dead zone for that long is at rest [s]."""
_DRIFT_S = 1.0
"""Time constant with which the dead zone follows a hand at rest [s]: slow drift of the tracking moves nothing."""
_LONGEST_S = 0.1
"""Longest time step between poses [s]; longer ones are cut to this."""
_FASTEST = 5.0, 25.0
"""Motion of tracked poses above this [m/s and rad/s] is a jump of the tracking."""


class Rest:
    """Decides whether a value is at rest: within `size` of a centre that follows it slowly."""

    def __init__(self, size: float) -> None:
        self._size = size
        self.restart(np.zeros(3))

    def restart(self, value: Vector) -> None:
        """Begin at rest at a value, shape (3,)."""
        self._centre = value
        self._within_s = 0.0
        self.is_rest = True

    def update(self, value: Vector, dt: float) -> None:
        """Take the next value, `dt` [s] after the previous one."""
        if math.dist(value, self._centre) > self._size:
            self._centre, self._within_s, self.is_rest = value, 0.0, False
            return
        self._within_s += dt
        if not self.is_rest and self._within_s >= _REST_S:
            self.is_rest = True
        if self.is_rest:
            self._centre = self._centre + min(1.0, dt / _DRIFT_S) * (value - self._centre)


class HandMotion:
    """How far a hand has moved since the clutch engaged, in the robot's base frame.

    Attributes:
        moved: displacement, scaled [m], shape (3,).
        turned: rotation matrix, shape (3, 3).
    """

    def __init__(self, options: WebxrOptions) -> None:
        self._options = options
        self._filter = PoseFilter(options.cutoff, options.cutoff_slope)
        self._rests = Rest(options.dead_zone), Rest(options.dead_angle)
        self._to_base = _TO_ROBOT
        self._time_s = 0.0
        self._last = np.zeros(3), np.eye(3)
        """The newest pose, unfiltered."""
        self._origin, self._upright = np.zeros(3), np.eye(3)
        """The pose of the hand that means no motion."""
        self._first = np.eye(3)
        self.moved, self.turned = np.zeros(3), np.eye(3)

    @property
    def cutoff_hz(self) -> float:
        """The present cutoff of the filter [Hz]."""
        return self._filter.cutoff_hz

    def engage(self, pose: HandPose, heading: float, time_s: float) -> None:
        """Start from a pose, at rest.

        Args:
            pose: the pose.
            heading: direction in which the operator looks, in WebXR's frame [rad].
            time_s: the page's time [s].
        """
        self._to_base = exp(np.array([0.0, 0.0, self._options.facing - heading])) @ _TO_ROBOT
        self.moved, self.turned = np.zeros(3), np.eye(3)
        self._start(pose, time_s)

    def update(self, pose: HandPose, time_s: float) -> None:
        """Follow the hand to a pose at the page's time [s]."""
        options = self._options
        dt = min(time_s - self._time_s, _LONGEST_S)
        if dt <= 0:
            return
        position, rotation = self._in_base(pose)
        speeds = math.dist(position, self._last[0]) / dt, np.linalg.norm(log(rotation @ self._last[1].T)) / dt
        if speeds[0] > _FASTEST[0] or speeds[1] > _FASTEST[1]:
            self._start(pose, time_s)
            return
        self._last, self._time_s = (position, rotation), time_s
        self._filter.update(position, rotation, dt)
        pushed = self._to_base @ pose.move * options.stick_speed * dt
        self.moved = self.moved + pushed
        self._origin = self._origin - pushed / options.scale
        position, rotation = self._filter.position, self._filter.rotation
        self._rests[0].update(position, dt)
        self._rests[1].update(log(rotation @ self._first.T), dt)
        # At rest the origin follows the hand, so that `moved` and `turned` keep their values.
        if self._rests[0].is_rest:
            self._origin = position - self.moved / options.scale
        else:
            self.moved = options.scale * (position - self._origin)
        if self._rests[1].is_rest:
            self._upright = self.turned.T @ rotation
        else:
            self.turned = rotation @ self._upright.T

    def _start(self, pose: HandPose, time_s: float) -> None:
        """Take a pose as the present one, without changing `moved` and `turned`."""
        self._last = position, rotation = self._in_base(pose)
        self._time_s = time_s
        self._filter.restart(position, rotation)
        self._first = rotation
        self._origin = position - self.moved / self._options.scale
        self._upright = self.turned.T @ rotation
        self._rests[0].restart(position)
        self._rests[1].restart(np.zeros(3))

    def _in_base(self, pose: HandPose) -> tuple[Vector, Vector]:
        """Position and rotation in the frame of the base."""
        position = np.zeros(3) if pose.position is None else self._to_base @ pose.position
        return position, self._to_base @ from_quaternion(pose.orientation)
