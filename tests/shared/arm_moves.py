"""Commands of an SO-101 that show what its parameters are."""

from __future__ import annotations

import numpy as np

from ibrobot_core.api import Vector

TICK_NS = 10_000_000
MIDDLE = (0.0, -0.6, 0.2, 0.0, 0.0, 0.6)
"""About where the arm moves [rad], clear of the table."""


def moves(seconds: float, seed: int = 0, reach: float = 0.45) -> Vector:
    """Commands above the table that show everything: fast and slow, wide and small, with pauses, shape (N, 6)."""
    rng = np.random.default_rng(seed)
    count = round(seconds * 1e9 / TICK_NS)
    columns = []
    for middle in MIDDLE:
        here, row = 0.0, list[float]()
        while len(row) < count:
            is_small = rng.random() < 0.35
            there = here + rng.choice((-1, 1)) * 0.05 if is_small else middle + rng.uniform(-reach, reach)
            steps = max(8, round(abs(there - here) / rng.choice((0.15, 0.6, 2.5)) * 100))
            share = np.linspace(0, 1, steps)
            row += list(here + (there - here) * share * share * (3 - 2 * share))
            row += [there] * int(rng.integers(5, 60))
            here = there
        columns.append(row[:count])
    return np.array(columns).T
