"""Quadratic programs with bounds."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_kinematics.servo import bounded_minimum

from ibrobot_core.api import Vector

seeds = st.integers(0, 2**32 - 1).map(np.random.default_rng)


@st.composite
def programs(draw: st.DrawFn) -> tuple[Vector, Vector, Vector, Vector]:
    rng, n = draw(seeds), draw(st.integers(1, 7))
    rows = rng.normal(size=(draw(st.integers(1, 8)), n))
    bounds = [rng.random(n) * rng.choice([0.0, 0.01, 1.0, 100.0], size=n) for _ in range(2)]
    return rows.T @ rows + 1e-7 * np.eye(n), rng.normal(size=n), -bounds[0], bounds[1]


@given(programs())
def test_bounded_minimum_is_optimal(program: tuple[Vector, Vector, Vector, Vector]):
    """At a minimum of a convex function no step inwards goes down (Karush, Kuhn and Tucker)."""
    hessian, gradient, lower, upper = program
    x = bounded_minimum(hessian, gradient, lower, upper)
    assert np.all((lower <= x) & (x <= upper))
    slope = hessian @ x + gradient
    tolerance = 1e-6 * (1 + np.abs(hessian).max() * np.abs(x).max())
    assert np.all((slope >= -tolerance) | (x >= upper))
    assert np.all((slope <= tolerance) | (x <= lower))
