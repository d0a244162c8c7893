"""Distance of an arm from the objects of the run's world."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs

from ibrobot_core.api import PlanningError, Vector, documented, option
from ibrobot_core.app import Bus, Service


@documented
@attrs.frozen
class Configuration:
    """A request to `/world/clearance`: a configuration of the arm."""

    positions: Mapping[str, float] = option(
        factory=dict, unit="rad or m", help="positions of joints; other joints: the measured position"
    )


CLEARANCE = Service(
    "/world/clearance",
    Configuration,
    float,
    "Distance from the nearest object [m]; an error if the objects are too old.",
    reads=True,
)


def world_clearance(bus: Bus | None, joints: Sequence[str]) -> Callable[[Vector], float] | None:
    """The `clearance` of a `Servo`.

    Args:
        bus: the bus of the run.
        joints: names of the joints that the servo moves.

    Returns:
        Joint positions -> distance from the nearest object [m]: infinite without a world; minus infinity, so that the
        tool stops, if it cannot be determined, e.g. because a depth camera is silent. None without a bus.
    """
    if bus is None:
        return None

    def clearance(position: Vector) -> float:
        if not bus.serves(CLEARANCE):
            return math.inf
        try:
            return bus.call(CLEARANCE, Configuration(dict(zip(joints, position.tolist(), strict=True))))
        except PlanningError:  # the section `world` logs what is too old
            return -math.inf

    return clearance
