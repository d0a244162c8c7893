"""Distance of the arm, and of what it carries, from the objects of a world."""

from __future__ import annotations

import math

import pinocchio

from ibrobot_core.api import Vector
from ibrobot_planning.world.arm import Arm
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import World


class Clearance:
    """Distances in one world. Not for use by several threads.

    Args:
        arm: the arm.
        world: its objects; those that a link carries belong to the arm.
    """

    def __init__(self, arm: Arm, world: World) -> None:
        self._checks = Collisions(arm, world, arm.joint_names)
        standing = {name for name, thing in world.objects.items() if thing.link is None}
        self._pairs = [number for number, names in enumerate(self._checks.pairs) if standing.intersection(names)]

    def __call__(self, q: Vector) -> float:
        """Distance from the nearest object [m] at `q`, shape (J,): negative in contact, infinite without objects."""
        checks = self._checks
        native = checks.native(q[None])[0]
        pinocchio.updateGeometryPlacements(checks.arm.model, checks.data, checks.geometry, checks.results, native)
        distance = pinocchio.computeDistance
        return min(
            (float(distance(checks.geometry, checks.results, number).min_distance) for number in self._pairs),
            default=math.inf,
        )
