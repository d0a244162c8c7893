"""Lead-in: a smooth transition from the held position, or from the previous plan, into a new plan."""

from __future__ import annotations

import math

import attrs
import numpy as np

from ibrobot_core.robot import Vector

_SHARE = 0.5
"""Fraction of the limits available to the lead-in; the rest is left to the chunk's own motion."""


@attrs.frozen(eq=False)
class LeadIn:
    """Makes a chunk start at the held position, or on the previous plan.

    Args:
        step_s: time between actions [s].
        max_velocity: of each joint [rad/s], shape (A,).
        max_acceleration: of each joint [rad/s^2], shape (A,).
    """

    step_s: float
    max_velocity: Vector
    max_acceleration: Vector

    def __call__(self, before: Vector, actions: Vector) -> Vector:
        """Return the actions, shape (N, A), changed so that they continue from `before`.

        The differences in position and speed are added to the actions and fade out along a cubic, which uses half of
        the limits of the joint with the longest way. A chunk shorter than the cubic ends before it has faded out.

        Args:
            before: the commands without the new chunk: those at the first and second action, shape (2, A); or the
                position at which the arm is held, shape (1, A).
            actions: the new commands.
        """
        gap = before[0] - actions[0]
        if not gap.any():
            return actions  # they already continue from there
        lag = before[-1] - before[0] - (actions[1 % len(actions)] - actions[0])
        speed = np.abs(lag) / self.step_s
        # Over a time T, the cubic from a distance has the peaks 1.5 / T and 6 / T^2, the one from a speed 1 and 4 / T.
        limit = _SHARE * self.max_acceleration
        by_acceleration = (2 * speed + np.sqrt(4 * speed**2 + 6 * limit * np.abs(gap))) / limit
        by_velocity = 1.5 * np.abs(gap) / (_SHARE * self.max_velocity)
        steps = math.ceil(max(by_velocity.max(), by_acceleration.max()) / self.step_s)
        s = np.minimum(np.arange(len(actions)) / steps, 1.0)[:, None]
        result: Vector = actions + (1 - s**2 * (3 - 2 * s)) * gap + steps * s * (1 - s) ** 2 * lag
        return result
