"""Leading over: the first actions of a plan go on from where the arm is held, or from the plan before."""

from __future__ import annotations

import math

import attrs
import numpy as np

from ibrobot_core.robot import Vector

_SHARE = 0.5
"""Of the limits, what leading over may take by itself; the rest is for the chunk's own motion."""


@attrs.frozen(eq=False)
class LeadIn:
    """Leads from where the arm is held, or from a plan, into a chunk.

    Args:
        step_s: time from one action to the next [s].
        max_velocity: of each joint [rad/s], shape (A,).
        max_acceleration: of each joint [rad/s^2], shape (A,).
    """

    step_s: float
    max_velocity: Vector
    max_acceleration: Vector

    def __call__(self, before: Vector, actions: Vector) -> Vector:
        """The actions, shape (N, A), changed so that they go on from `before`.

        What is missing to where the arm would be, and to its speed there, is added and fades along a cubic that takes
        half of the limits of the joint with the furthest to go. A chunk shorter than that ends on the way.

        Args:
            before: the commands of the arm otherwise: at the first of the actions, and at the next, shape (2, A); or
                where it is held, shape (1, A).
            actions: the commands from now on.
        """
        gap = before[0] - actions[0]
        if not gap.any():
            return actions  # they go on from there by themselves
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
