"""Distance of an arm from the objects of the run's world."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs

from ibrobot_core.api import Vector, documented, option
from ibrobot_core.app import Bus, Service


@documented
@attrs.frozen
class Configuration:
    """A request to `/world/clearance`: a configuration of the arm."""

    positions: Mapping[str, float] = option(
        factory=dict, unit="rad or m", help="positions of joints; other joints: the measured position"
    )


CLEARANCE = Service("/world/clearance", Configuration, float, "Distance from the nearest object [m].")


def world_clearance(bus: Bus | None, joints: Sequence[str]) -> Callable[[Vector], float] | None:
    """The `clearance` of a `Servo`.

    Args:
        bus: the bus of the run.
        joints: names of the joints that the servo moves.

    Returns:
        Joint positions -> distance from the nearest object [m], infinite without a world. None without a bus.
    """
    if bus is None:
        return None

    def clearance(position: Vector) -> float:
        if not bus.serves(CLEARANCE):
            return math.inf
        return bus.call(CLEARANCE, Configuration(dict(zip(joints, position.tolist(), strict=True))))

    return clearance
