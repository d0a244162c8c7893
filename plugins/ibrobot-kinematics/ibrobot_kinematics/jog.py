"""Tool jog: a small step of the tip along a twist, by differential inverse kinematics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.model import KinematicModel
from ibrobot_kinematics.quadratic import bounded_minimum
from ibrobot_kinematics.rotations import exp, log

_LEVER_M = 0.1
"""Turning the tip by a radian weighs as much as moving it by this [m]."""
_MOST_MISSED = 0.5
"""Share of a step by which the tip may miss its target; where it would miss by more, the reach ends and it stays."""
_DAMPING = 1e-7


def jog(
    model: KinematicModel,
    q: Vector,
    linear: Vector,
    angular: Vector,
    dt: float,
    max_velocity: Vector,
    *,
    turn_weights: Sequence[float] = (0.05, 1.0, 1.0),
) -> Vector:
    """Joint positions after the tip moved for `dt` with a twist, within limits and joint speeds.

    The tip follows the twist as well as the arm can. At the edge of the reach, where it would go elsewhere, the arm
    stays. A joint beyond a limit does not go further out.

    Args:
        model: the arm.
        q: joint positions [rad or m], shape (J,).
        linear: velocity of the tip's origin in the base frame [m/s], shape (3,).
        angular: angular velocity of the tip in the base frame [rad/s], shape (3,).
        dt: duration of the step [s], above zero.
        max_velocity: highest speed of each joint [rad/s or m/s], shape (J,).
        turn_weights: how much turns about the tip's own x, y and z axes count, shape (3,). By default an arm with five
            joints, which cannot control all of them, gives way about the tip's x axis: the heading of a tool that
            points along z.

    Returns:
        Joint positions [rad or m], shape (J,); equal to `q` where the tip cannot go on in this direction.
    """
    moving = model.moving
    start = q.copy()
    start[moving] = np.clip(q[moving], model.lower[moving], model.upper[moving])
    tip, jacobian = model.forward_and_jacobian(start)
    weights = np.concatenate([np.ones(3), _LEVER_M * np.asarray(turn_weights)])
    to_tip = tip.rotation.T
    # Turns in the frame of the tip, where their weights are.
    rates = weights[:, None] * np.vstack([jacobian[:3, moving], to_tip @ jacobian[3:, moving]])
    asked = weights * np.concatenate([linear, to_tip @ angular]) * dt
    reach = max_velocity[moving] * dt
    step = bounded_minimum(
        rates.T @ rates + _DAMPING * np.eye(len(moving)),
        -rates.T @ asked,
        np.maximum(model.lower[moving] - start[moving], -reach),
        np.minimum(model.upper[moving] - start[moving], reach),
    )
    after = start.copy()
    after[moving] += step
    reached = model.forward(after)
    target = tip.rotation @ exp(to_tip @ angular * dt)
    missed = weights * np.concatenate([
        reached.position - tip.position - linear * dt, log(target.T @ reached.rotation),
    ])  # fmt: skip
    if np.linalg.norm(missed) > _MOST_MISSED * np.linalg.norm(asked):
        return q
    moved = q.copy()
    moved[moving] += step
    return moved
