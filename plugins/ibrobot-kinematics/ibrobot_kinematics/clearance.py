"""Distance of an arm from the objects around it, as the run's world knows them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from ibrobot_core.api import Bus, Vector

CLEARANCE = "/world/clearance"
"""Service: positions [rad or m] by joint; the others are measured -> distance from the nearest object [m]."""


def world_clearance(bus: Bus | None, joints: Sequence[str]) -> Callable[[Vector], float] | None:
    """The `clearance` of a `Servo`.

    Args:
        bus: of the run.
        joints: names of the joints that the servo moves.

    Returns:
        Joint positions -> distance from the nearest object [m], infinite while nobody knows any. None without a bus.
    """
    if bus is None:
        return None

    def clearance(position: Vector) -> float:
        if not bus.serves(CLEARANCE):
            return math.inf
        return float(bus.call(CLEARANCE, dict(zip(joints, position.tolist(), strict=True))))

    return clearance
