"""Collision checks of an arm in a world, with padding."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import product

import attrs
import numpy as np
import pinocchio

from ibrobot_core.api import PlanCode, PlanningError, Vector
from ibrobot_planning.arm import ADJACENT, ALWAYS, NEVER, Arm, LinkShape, Pair, reach, sorted_pair
from ibrobot_planning.shapes import geometry
from ibrobot_planning.transforms import matrix
from ibrobot_planning.world import World

_SAMPLES = 1000
"""Number of configurations that determine which links always touch."""
_ALWAYS_SHARE = 0.95
"""Links that touch in at least this share of configurations always touch, as in MoveIt's setup assistant."""


@attrs.frozen
class Contact:
    """Two things that are closer than their padding."""

    first: str
    second: str
    distance: float
    """[m]; negative if they overlap."""
    padding: float
    """Required distance [m]."""

    def __str__(self) -> str:
        if self.distance <= 0:
            return f"{self.first} overlaps {self.second} by {-1000 * self.distance:.1f} mm"
        return (
            f"{self.first} is {1000 * self.distance:.1f} mm from {self.second}, with {1000 * self.padding:.1f} mm asked"
        )


class Collisions:
    """Checks configurations of some joints of an arm, in one world. Not for use by several threads.

    Args:
        arm: the arm.
        world: what is around it, and what it carries.
        joints: the joints that vectors have, J in number.
        others: positions of further joints [rad]; those left out are at 0.
        padding: least distance [m] from objects that stand in the world; also that of carried objects from them.
        self_padding: least distance [m] between links, and between links and what other links carry.
        unchecked: pairs of links that may touch; see `unchecked_pairs`.

    Attributes:
        data: pinocchio.Data.
        geometry: pinocchio.GeometryModel with all shapes and pairs.
        results: pinocchio.GeometryData, with the padding of each pair.

    Raises:
        PlanningError: for a joint or link that the arm does not have.
    """

    def __init__(
        self, arm: Arm, world: World, joints: Sequence[str], others: Mapping[str, float] | None = None, *,
        padding: float = 0.0, self_padding: float = 0.0, unchecked: Collection[Pair] = (),
    ) -> None:  # fmt: skip
        for name in (*joints, *(others or {})):
            if name not in arm.joint_names:
                raise PlanningError(
                    f"no joint {name!r}; the joints are: {', '.join(arm.joint_names)}", PlanCode.INVALID_GROUP_NAME
                )
        self.arm, self.world = arm, world
        self._base = np.array([(others or {}).get(name, 0.0) for name in arm.joint_names])
        self._indices = np.array([arm.joint_names.index(name) for name in joints], dtype=np.intp)
        shapes = [*arm.shapes, *_objects(arm, world)]
        self.reach = reach(arm, shapes)[self._indices]
        """Maximum motion of any point per joint [m/rad], shape (J,)."""
        self._names = [shape.link for shape in shapes]
        self.geometry = pinocchio.GeometryModel()
        for number, shape in enumerate(shapes):
            self.geometry.addGeometryObject(
                pinocchio.GeometryObject(f"{number}", shape.joint, pinocchio.SE3(shape.placement), shape.geometry)
            )
        margins = []
        for first, second, margin in _pairs(arm, world, shapes, padding, self_padding, set(unchecked)):
            self.geometry.addCollisionPair(pinocchio.CollisionPair(first, second))
            margins.append(margin)
        self.data = arm.model.createData()
        self.results = self.geometry.createData()
        for request, margin in zip(self.results.collisionRequests, margins, strict=True):
            request.security_margin = margin
        self._margins = margins
        # The naive manager compares all bounding boxes natively: for the few dozen shapes of an arm it is the fastest.
        # It widens them by the margins, which must therefore be set before.
        self._manager = pinocchio.BroadPhaseManager_NaiveCollisionManager(arm.model, self.geometry, self.results)

    @property
    def pairs(self) -> list[Pair]:
        """Names of what each pair of `geometry.collisionPairs` has, links and objects."""
        return [(self._names[pair.first], self._names[pair.second]) for pair in self.geometry.collisionPairs]

    def free(self, q: Vector) -> bool:
        """Whether `q`, shape (J,), is free of contacts."""
        return self.first_hit(q[None]) == 1

    def first_hit(self, configurations: Vector) -> int:
        """Number of free configurations before the first in collision, of shape (N, J)."""
        model, data, manager, check = self.arm.model, self.data, self._manager, pinocchio.computeCollisions
        for number, q in enumerate(self.native(configurations)):
            if check(model, data, manager, q, True):
                return number
        return len(configurations)

    def contacts(self, q: Vector) -> list[Contact]:
        """Contacts closer than their padding at `q`, shape (J,): the closest of each pair of names, deepest first."""
        pinocchio.computeCollisions(
            self.arm.model, self.data, self.geometry, self.results, self.native(q[None])[0], False
        )
        found: dict[Pair, Contact] = {}
        for number, (pair, margin) in enumerate(zip(self.geometry.collisionPairs, self._margins, strict=True)):
            if not self.results.collisionResults[number].isCollision():
                continue
            first, second = self._names[pair.first], self._names[pair.second]
            distance = pinocchio.computeDistance(self.geometry, self.results, number).min_distance
            contact = Contact(first, second, float(distance), margin)
            known = found.get((first, second))
            if known is None or contact.distance < known.distance:
                found[first, second] = contact
        return sorted(found.values(), key=lambda contact: contact.distance)

    def distances(self, q: Vector) -> dict[Pair, float]:
        """Distance [m] of each checked pair of names at `q`, shape (J,); negative where they overlap."""
        pinocchio.computeDistances(self.arm.model, self.data, self.geometry, self.results, self.native(q[None])[0])
        found: dict[Pair, float] = {}
        for pair, result in zip(self.geometry.collisionPairs, self.results.distanceResults, strict=True):
            names = self._names[pair.first], self._names[pair.second]
            found[names] = min(float(result.min_distance), found.get(names, np.inf))
        return found

    def native(self, configurations: Vector) -> Vector:
        """Configurations of the planned joints, shape (N, J), completed with all other joints for Pinocchio."""
        whole = np.repeat(self._base[None], len(configurations), axis=0)
        whole[:, self._indices] = configurations
        return self.arm.native(whole)


def unchecked_pairs(arm: Arm, *, samples: int = _SAMPLES, seed: int = 0, never: bool = False) -> dict[Pair, str]:
    """Pairs of links that need no check, with the reason, found as MoveIt's setup assistant does.

    Args:
        arm: the arm.
        samples: random configurations to look at.
        seed: of the random configurations.
        never: whether to add pairs that touch in none of the configurations. That saves little time, and rare contacts
            may be among them.
    """
    found = dict.fromkeys(arm.adjacent(), ADJACENT)
    checks = Collisions(arm, World(), arm.joint_names, unchecked=found)
    touching: dict[Pair, int] = {}
    for q in np.random.default_rng(seed).uniform(arm.lower, arm.upper, (samples, len(arm.joint_names))):
        for contact in checks.contacts(q) if not checks.free(q) else ():
            pair = sorted_pair(contact.first, contact.second)
            touching[pair] = touching.get(pair, 0) + 1
    for i, j in arm.pairs():
        pair = sorted_pair(arm.shapes[i].link, arm.shapes[j].link)
        if pair in found:
            continue
        if touching.get(pair, 0) >= _ALWAYS_SHARE * samples:
            found[pair] = ALWAYS
        elif never and pair not in touching:
            found[pair] = NEVER
    return found


def _objects(arm: Arm, world: World) -> list[LinkShape]:
    """Objects as shapes, each with the link that carries it, if any."""
    shapes = []
    for name, thing in world.objects.items():
        if name in arm.frames:
            raise PlanningError(f"an object has the name of link {name!r}", PlanCode.INVALID_OBJECT_NAME)
        joint, frame = (0, np.eye(4)) if thing.link is None else arm.frame(thing.link)
        shapes.append(LinkShape(name, joint, frame @ matrix(thing.pose), geometry(thing.shape)))
    return shapes


def _pairs(
    arm: Arm, world: World, shapes: Sequence[LinkShape], padding: float, self_padding: float, unchecked: set[Pair]
) -> list[tuple[int, int, float]]:
    """Indices of shapes to check, with their margins."""
    touching = set(unchecked)
    known = {*arm.frames, *world.objects}
    for name, thing in world.objects.items():
        for other in thing.may_touch:
            if other not in known:
                raise PlanningError(
                    f"object {name!r} may touch {other!r}, which is neither a link nor an object;"
                    f" available: {', '.join(known)}",
                    PlanCode.INVALID_LINK_NAME,
                )
            touching.add(sorted_pair(name, other))
    links = len(arm.shapes)
    found = []
    candidates = [*arm.pairs(), *product(range(links), range(links, len(shapes)))]
    candidates += [(i, j) for i in range(links, len(shapes)) for j in range(i + 1, len(shapes))]
    for i, j in candidates:
        a, b = shapes[i], shapes[j]
        if a.joint == b.joint or sorted_pair(a.link, b.link) in touching:
            continue
        standing = any(name in world.objects and world.objects[name].link is None for name in (a.link, b.link))
        found.append((i, j, padding if standing else self_padding))
    return found
