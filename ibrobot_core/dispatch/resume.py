"""Going on after a hold: the first actions of the plan lead over from where the arm was held."""

from __future__ import annotations

import math

import attrs
import numpy as np

from ibrobot_core.robot import Vector

_SHARE = 0.5
"""Of the limits, what leading over may take by itself; the rest is for the chunk's own motion."""


@attrs.frozen(eq=False)
class LeadIn:
    """Leads from a held position into a chunk.

    Args:
        step_s: time from one action to the next [s].
        max_velocity: of each joint [rad/s], shape (A,).
        max_acceleration: of each joint [rad/s^2], shape (A,).
    """

    step_s: float
    max_velocity: Vector
    max_acceleration: Vector

    def __call__(self, held: Vector, actions: Vector) -> Vector:
        """The actions, shape (N, A), with the distance from `held`, shape (A,), to the first taken out smoothly.

        The distance is added and fades along a cubic that takes, for the joint with the furthest to go, half of its
        velocity or of its acceleration limit. A chunk shorter than that ends on the way.
        """
        gap = held - actions[0]
        # The cubic 3 s^2 - 2 s^3 over a time T has the peaks 1.5 / T and 6 / T^2.
        by_velocity = 1.5 * np.abs(gap) / (_SHARE * self.max_velocity)
        by_acceleration = np.sqrt(6 * np.abs(gap) / (_SHARE * self.max_acceleration))
        steps = math.ceil(max(by_velocity.max(), by_acceleration.max()) / self.step_s)
        if not steps:
            return actions
        s = np.minimum(np.arange(len(actions)) / steps, 1.0)
        result: Vector = actions + (1 - s**2 * (3 - 2 * s))[:, None] * gap
        return result
