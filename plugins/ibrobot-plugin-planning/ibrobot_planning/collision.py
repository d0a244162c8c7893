"""Collision checks of an arm in a world, with padding."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import Any

import attrs
import numpy as np
import pinocchio

from ibrobot_core.api import PlanCode, PlanningError, Vector
from ibrobot_planning.arm import ADJACENT, ALWAYS, NEVER, Arm, LinkShape, Pair, reach, sorted_pair
from ibrobot_planning.shapes import geometry
from ibrobot_planning.transforms import matrix
from ibrobot_planning.world import World

_FEW = 4
"""Lines of so few configurations are checked one by one."""
_SAMPLES = 1000
"""Number of configurations that determine which links always touch."""
WIDER_M = (0.0, 0.004, 0.02)
"""Distances [m] by which margins are widened: as long as nothing is closer than a widened margin, the arm can move by
that distance without a check."""
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
        indices = np.array([arm.joint_names.index(name) for name in joints], dtype=np.intp)
        self._still = arm.native(np.array([(others or {}).get(name, 0.0) for name in arm.joint_names]))
        self._columns, self._reference = arm.columns[indices], arm.reference[indices]
        shapes = [*arm.shapes, *_objects(arm, world)]
        self.reach = reach(arm, shapes)[indices]
        """Maximum motion of any point per joint [m/rad], shape (J,)."""
        self._names = [shape.link for shape in shapes]
        self.geometry = pinocchio.GeometryModel()
        for number, shape in enumerate(shapes):
            self.geometry.addGeometryObject(
                pinocchio.GeometryObject(f"{number}", shape.joint, pinocchio.SE3(shape.placement), shape.geometry)
            )
        checked, self._margins = _pairs(arm, world, shapes, padding, self_padding, set(unchecked))
        self.geometry.setCollisionPairs(checked, True)
        self.data = arm.model.createData()
        self.results = self.geometry.createData()
        self.results.setSecurityMargins(self.geometry, self._margins, True, True)
        self._results = [self.results]
        self._managers = [self._manager(self.results)]

    def _manager(self, results: Any) -> Any:
        # The naive manager compares all bounding boxes natively: for the few dozen shapes of an arm it is the fastest.
        # It widens them by the margins, which must therefore be set before.
        return pinocchio.BroadPhaseManager_NaiveCollisionManager(self.arm.model, self.geometry, results)

    @cached_property
    def _wider(self) -> list[Any]:
        """A manager for each of the margins that `WIDER_M` widens."""
        for width in WIDER_M[1:]:
            results = self.geometry.createData()
            results.setSecurityMargins(self.geometry, self._margins + width, True, True)
            self._results.append(results)
            self._managers.append(self._manager(results))
        return self._managers

    @property
    def pairs(self) -> list[Pair]:
        """Names of what each pair of `geometry.collisionPairs` has, links and objects."""
        return [(self._names[pair.first], self._names[pair.second]) for pair in self.geometry.collisionPairs]

    def free(self, q: Vector) -> bool:
        """Whether `q`, shape (J,), is free of contacts."""
        return self.first_hit(q[None]) == 1

    def first_hit(self, configurations: Vector) -> int:
        """Number of free configurations before the first in collision, of shape (N, J)."""
        model, data, manager, check = self.arm.model, self.data, self._managers[0], pinocchio.computeCollisions
        for number, q in enumerate(self.native(configurations)):
            if check(model, data, manager, q, True):
                return number
        return len(configurations)

    def first_hit_on_path(self, path: Vector) -> int:
        """Number of free configurations before the first in collision, of a path in small steps, shape (N, J).

        Equal to `first_hit`, with fewer checks: a configuration that is free with a margin wider by w proves that all
        those are free to which no point of the arm moves farther than w.
        """
        model, data, managers, check = self.arm.model, self.data, self._wider, pinocchio.computeCollisions
        native, number = self.native(path), len(path)
        travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)) @ self.reach)]).tolist()
        level, at, narrow = len(managers) - 1, 0, [-1] * len(managers)
        while at < number:
            middle = at if level == 0 else bisect_right(travel, travel[at] + WIDER_M[level]) - 1
            if level and middle == at:
                level -= 1
                continue
            if check(model, data, managers[level], native[middle], True):
                if level == 0:
                    return at
                narrow[level] = middle
                level -= 1
            else:
                at = middle + 1 if level == 0 else bisect_right(travel, travel[middle] + WIDER_M[level])
                if level + 1 < len(managers) and at > narrow[level + 1]:
                    level += 1
        return number

    def line_free(self, a: Vector, b: Vector, resolution: float) -> bool:
        """Whether the straight line from `a`, which is not checked, to `b` is free, both shape (J,).

        Args:
            a: begin.
            b: end.
            resolution: maximum motion of any point of the arm between two checks [m].
        """
        model, data, managers, check = self.arm.model, self.data, self._managers, pinocchio.computeCollisions
        begin, way = self._still.copy(), np.zeros(len(self._still))
        begin[self._columns] = a - self._reference
        way[self._columns] = b - a
        travel = float(np.abs(b - a) @ self.reach)
        number = max(math.ceil(travel / resolution), 1)
        if number <= _FEW:
            return not any(
                check(model, data, managers[0], begin + (i + 1) / number * way, True) for i in spread(number)
            )
        managers = self._wider
        level = min(bisect_right(WIDER_M, travel), len(WIDER_M) - 1)
        proved = bytearray(number)
        for i in spread(number):
            if proved[i]:
                continue
            q = begin + (i + 1) / number * way
            covers = int(WIDER_M[level] / travel * number)
            if covers:
                if not check(model, data, managers[level], q, True):
                    first, last = max(i - covers, 0), min(i + covers + 1, number)
                    proved[first:last] = b"\1" * (last - first)
                    continue
                level -= 1
            if check(model, data, managers[0], q, True):
                return False
        return True

    def contacts(self, q: Vector) -> list[Contact]:
        """Contacts closer than their padding at `q`, shape (J,): the closest of each pair of names, deepest first."""
        pinocchio.computeCollisions(
            self.arm.model, self.data, self.geometry, self.results, self.native(q[None])[0], False
        )
        found: dict[Pair, Contact] = {}
        for number, (pair, result) in enumerate(
            zip(self.geometry.collisionPairs, self.results.collisionResults, strict=True)
        ):
            if not result.isCollision():
                continue
            first, second = self._names[pair.first], self._names[pair.second]
            distance = pinocchio.computeDistance(self.geometry, self.results, number).min_distance
            contact = Contact(first, second, float(distance), float(self._margins[pair.first, pair.second]))
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
        whole = np.empty((len(configurations), len(self._still)))
        whole[:] = self._still
        whole[:, self._columns] = configurations - self._reference
        return whole


_SPREADS: dict[int, list[int]] = {}


def spread(number: int) -> list[int]:
    """Indices 0 to number - 1, each far from those before it (van der Corput)."""
    if number not in _SPREADS:
        bits = max(number - 1, 1).bit_length()
        codes = np.arange(1 << bits)
        reversed_bits = np.asarray(sum(((codes >> i) & 1) << (bits - 1 - i) for i in range(bits)))
        # The middle comes before the ends.
        _SPREADS[number] = [*reversed_bits[(reversed_bits < number) & (reversed_bits > 0)].tolist(), 0]
    return _SPREADS[number]


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
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.bool_]], Vector]:
    """Which pairs of shapes to check, and their margins [m], both shape (S, S)."""
    names = list(dict.fromkeys(shape.link for shape in shapes))
    numbers = {name: number for number, name in enumerate(names)}
    apart = np.ones((len(names), len(names)), dtype=bool)
    known = {*arm.frames, *world.objects}
    touching = set(unchecked)
    for name, thing in world.objects.items():
        for other in thing.may_touch:
            if other not in known:
                raise PlanningError(
                    f"object {name!r} may touch {other!r}, which is neither a link nor an object;"
                    f" available: {', '.join(known)}",
                    PlanCode.INVALID_LINK_NAME,
                )
            touching.add((name, other))
    for first, second in touching:
        if first in numbers and second in numbers:
            apart[numbers[first], numbers[second]] = apart[numbers[second], numbers[first]] = False
    standing = np.array([name in world.objects and world.objects[name].link is None for name in names])
    of = np.array([numbers[shape.link] for shape in shapes], dtype=np.intp)
    joints = np.array([shape.joint for shape in shapes])
    checked = apart[np.ix_(of, of)] & (joints[:, None] != joints[None])
    return checked, np.where(standing[of][:, None] | standing[of][None], padding, self_padding)
