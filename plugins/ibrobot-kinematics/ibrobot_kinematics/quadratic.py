"""Small quadratic programs with bounds."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Vector


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
