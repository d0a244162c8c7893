"""Checks of whole trajectories against a world: for planners, and for goals from outside."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from ibrobot_core.api import JointTrajectory, Pose, Vector, Vector3, seconds
from ibrobot_core.app import Bus
from ibrobot_planning.planners.timing import motion_of
from ibrobot_planning.world.arm import Arm
from ibrobot_planning.world.collision import Collisions, Contact
from ibrobot_planning.world.objects import FLOOR, Plane, World, WorldObject, world_of

CHECK_S = 0.001
"""Time between checks of a timed motion."""
_STRIDE = 2
"""Every second one of these times is checked in the present world."""
_PART_S = 5.0
"""Part of a long motion that is checked at a time: a change of the world is looked for in between [s]."""
_WORSE_M = 1e-4
"""Allowed decrease of a distance while the arm leaves a contact [m]."""


class Margins(Protocol):
    """Options that say how far the arm keeps away."""

    @property
    def padding(self) -> float:
        """Least distance of the arm from objects [m]."""

    @property
    def self_padding(self) -> float:
        """Least distance between links [m]."""

    @property
    def floor(self) -> float | None:
        """Height of the floor in the base frame [m]; everything below is blocked. None: that of the description."""


class ContactChecks(Protocol):
    """The part of a collision checker that looks at single configurations."""

    def free(self, q: Vector) -> bool:
        """Whether `q`, shape (J,), is free."""

    def contacts(self, q: Vector) -> list[Contact]:
        """Contacts closer than their padding at `q`, shape (J,)."""


class FreePaths:
    """Whether trajectories are free in the present world. Methods may be called from several threads.

    Args:
        arm: the arm, once it is loaded.
        bus: serves the world.
        floor: height of the floor for margins that do not say it [m]; None: there is none.
    """

    def __init__(self, arm: Callable[[], Arm], bus: Bus, floor: float | None) -> None:
        self._arm, self._bus, self._floor = arm, bus, floor
        self._free: deque[tuple[JointTrajectory, World]] = deque(maxlen=16)
        """Trajectories, each with the world in which it is free."""

    def snapshot(self, margins: Margins) -> World:
        """The present world, with the floor."""
        return with_floor(world_of(self._bus), self._floor if margins.floor is None else margins.floor)

    def note(self, trajectory: JointTrajectory, world: World) -> None:
        """Remember that a trajectory, or all of it that is still new, is free in a world."""
        self._free.append((trajectory, world))

    def blocked(
        self, trajectory: JointTrajectory, others: Mapping[str, float], margins: Margins, from_ns: int = 0
    ) -> str:
        """What a trajectory touches in the present world, in words; empty if nothing. As `Planner.blocked`."""
        world = self.snapshot(margins)
        if any(known is trajectory and in_world == world for known, in_world in tuple(self._free)):
            return ""
        made = motion_of(trajectory)
        if made is None:
            return "a trajectory without velocities and accelerations cannot be checked"
        checks = collisions(self._arm(), world, trajectory.joint_names, others, margins)
        begin = begun = min(round(seconds(from_ns) / CHECK_S) * CHECK_S, made.duration)
        while True:
            positions = made.sampled(_STRIDE * CHECK_S, begin, begin + _PART_S)[0]
            leaving = 0
            if begin == begun:  # contacts at the start may open
                leaving = outwards(checks, positions) or 0
            hit = leaving + checks.first_hit_on_path(positions[leaving:])
            if hit < len(positions):
                return sentence(checks.contacts(positions[hit]))
            begin += _PART_S
            if begin >= made.duration:
                self.note(trajectory, world)
                return ""
            if from_ns and self.snapshot(margins) != world:
                return ""  # it is under way: the next check, which follows at once, begins with what comes first


def with_floor(world: World, floor: float | None) -> World:
    """The world with a floor at a height [m], unless it has one; None: no floor."""
    named = world.objects.get(FLOOR)
    if floor is None or (named is not None and isinstance(named.shape, Plane)):
        return world
    # Another object of this name does not take the table's place.
    return world.add(
        FLOOR if named is None else f"{FLOOR} of the planner", WorldObject(Plane(), Pose(Vector3(0.0, 0.0, floor)))
    )


def collisions(
    arm: Arm, world: World, joints: Sequence[str], others: Mapping[str, float], margins: Margins
) -> Collisions:
    """Checks of some joints in a world."""
    return Collisions(arm, world, joints, others, padding=margins.padding, self_padding=margins.self_padding)


def outwards(checks: ContactChecks, configurations: Vector) -> int | None:
    """Number of configurations before the first free one, while distances grow; None if one shrinks."""
    before = {(each.first, each.second): each.distance for each in checks.contacts(configurations[0])}
    for number, q in enumerate(configurations):
        if checks.free(q):
            return number
        now = {(each.first, each.second): each.distance for each in checks.contacts(q)}
        if any(pair not in before or distance < before[pair] - _WORSE_M for pair, distance in now.items()):
            return None
        before = {pair: max(distance, before[pair]) for pair, distance in now.items()}
    return None


def sentence(contacts: Sequence[Contact], most: int = 3) -> str:
    """The deepest contacts in words."""
    if not contacts:
        return "something touches"
    further = f", and {len(contacts) - most} more" if len(contacts) > most else ""
    return "; ".join(str(contact) for contact in contacts[:most]) + further
