"""The One Euro filter for poses: smooth at rest, quick in motion.

Source: G. Casiez, N. Roussel, D. Vogel: 1€ Filter: A Simple Speed-based Low-pass Filter for Noisy Input in Interactive
Systems, CHI 2012.
"""

from __future__ import annotations

import math

import numpy as np
from ibrobot_kinematics.rotations import exp, log

from ibrobot_core.api import Vector

LEVER_M = 0.2
"""A turn of a radian counts as this movement [m]."""
_SPEED_CUTOFF_HZ = 5.0
"""Cutoff of the filter of the speed."""


def delay(cutoff_hz: float) -> float:
    """The time [s] by which a first-order low-pass filter lags behind a steady motion."""
    return 1 / (2 * math.pi * cutoff_hz)


def _share(cutoff_hz: float, dt: float) -> float:
    """Weight of a new value in a first-order low-pass filter."""
    return 1 / (1 + delay(cutoff_hz) / dt)


class PoseFilter:
    """A low-pass filter of poses whose cutoff rises with their speed.

    Args:
        cutoff_hz: cutoff at rest [Hz].
        slope: increase of the cutoff with the speed [Hz s/m].

    Attributes:
        position: the filtered position [m], shape (3,).
        rotation: the filtered rotation matrix, shape (3, 3).
        cutoff_hz: the present cutoff [Hz].
    """

    def __init__(self, cutoff_hz: float, slope: float) -> None:
        self._least_hz = self.cutoff_hz = cutoff_hz
        self._slope = slope
        self.restart(np.zeros(3), np.eye(3))

    def restart(self, position: Vector, rotation: Vector) -> None:
        """Begin at a pose, at rest."""
        self.position, self.rotation = position, rotation
        self._before = position, rotation
        self._velocity = np.zeros(6)
        self.cutoff_hz = self._least_hz

    def update(self, position: Vector, rotation: Vector, dt: float) -> None:
        """Take the next pose, `dt` [s] after the previous one; ignored if no time has passed."""
        if dt <= 0:
            return
        moved = np.concatenate([position - self._before[0], LEVER_M * log(rotation @ self._before[1].T)]) / dt
        self._before = position, rotation
        self._velocity += _share(_SPEED_CUTOFF_HZ, dt) * (moved - self._velocity)
        speed = math.sqrt(float(self._velocity @ self._velocity))
        self.cutoff_hz = self._least_hz + self._slope * speed
        share = _share(self.cutoff_hz, dt)
        self.position = self.position + share * (position - self.position)
        self.rotation = exp(share * log(rotation @ self.rotation.T)) @ self.rotation
