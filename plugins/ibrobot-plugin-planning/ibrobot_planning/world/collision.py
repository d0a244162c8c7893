"""Collision checks of an arm in a world, with padding."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, Protocol

import attrs
import numpy as np
import pinocchio
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import PlanCode, PlanningError, Vector
from ibrobot_planning.world.arm import ADJACENT, ALWAYS, NEVER, Arm, LinkShape, Pair, reach, sorted_pair
from ibrobot_planning.world.coal_shapes import boxes, geometry
from ibrobot_planning.world.objects import Boxes, World

_FEW = 4
"""Lines of at most this many configurations are checked one by one."""
_SAMPLES = 1000
"""Number of configurations that determine which links always touch."""
WIDER_M = (0.0, 0.004, 0.02)
"""Distances [m] by which margins are widened: if nothing is closer than a widened margin, the arm can move that far
without a check."""
_ALWAYS_SHARE = 0.95
"""Links that touch in at least this share of configurations always touch, as in MoveIt's setup assistant."""

_WORSE_M = 1e-4
"""Allowed decrease of a distance while the arm leaves a contact [m]."""

type Flags = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


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
        world: the objects around it, and those that it carries.
        joints: the joints of vectors, J in number.
        others: positions of other joints [rad]; joints in neither are at 0.
        padding: least distance [m] of the arm, and of what it carries, from objects that stand in the world.
        self_padding: least distance [m] between links, and between links and what other links carry.

    Raises:
        PlanningError: for a joint or link that the arm does not have, or as `World.check`.
    """

    def __init__(
        self, arm: Arm, world: World, joints: Sequence[str], others: Mapping[str, float] | None = None, *,
        padding: float = 0.0, self_padding: float = 0.0,
    ) -> None:  # fmt: skip
        for name in (*joints, *(others or {})):
            if name not in arm.joint_names:
                raise PlanningError(
                    f"no joint {name!r}; the joints are: {', '.join(arm.joint_names)}", PlanCode.INVALID_GROUP_NAME
                )
        world.check(arm.frames)
        self.arm, self.world = arm, world
        indices = np.array([arm.joint_names.index(name) for name in joints], dtype=np.intp)
        self._still = arm.native(np.array([(others or {}).get(name, 0.0) for name in arm.joint_names]))
        self._columns, self._reference = arm.columns[indices], arm.reference[indices]
        objects = object_shapes(arm, world)
        self.reach = reach(arm, objects)[indices]
        """Maximum motion of any point per joint [m/rad], shape (J,)."""
        self.data = arm.model.createData()
        """pinocchio.Data."""

        def engine(links: Sequence[LinkShape]) -> Engine:
            shapes = [*links, *objects]
            return Engine(
                arm.model, self.data, shapes, *checked_pairs(world, shapes, padding, self_padding, arm.unchecked)
            )

        self._exact = engine(arm.shapes)
        self._coarse = engine(arm.hulls) if arm.hulls else self._exact
        """Contains everything that `_exact` has, in fewer shapes."""
        self.before: Callable[[], None] = lambda: None
        """Called before lines, paths and lists of configurations are checked; what it raises ends the check."""

    @property
    def geometry(self) -> Any:
        """pinocchio.GeometryModel with all shapes and pairs."""
        return self._exact.geometry

    @property
    def results(self) -> Any:
        """pinocchio.GeometryData, with the padding of each pair."""
        self._exact.widen(0)
        return self._exact.results

    @property
    def pairs(self) -> list[Pair]:
        """Names, of links and objects, for each of `geometry.collisionPairs`."""
        names = self._exact.names
        return [(names[pair.first], names[pair.second]) for pair in self.geometry.collisionPairs]

    def free(self, q: Vector) -> bool:
        """Whether `q`, shape (J,), is free of contacts."""
        return self.first_hit(q[None]) == 1

    def first_hit(self, configurations: Vector) -> int:
        """Number of free configurations before the first in collision, of shape (N, J)."""
        for number, q in enumerate(self.native(configurations)):
            if self.touches(q):
                return number
        return len(configurations)

    def first_hit_on_path(self, path: Vector) -> int:
        """Number of free configurations before the first in collision, of a path in small steps, shape (N, J).

        Equal to `first_hit`, with fewer checks: if a configuration is free with a margin wider by w, so are all
        configurations to which no point of the arm moves farther than w.
        """
        native, number, levels, widely = self.native(path), len(path), len(WIDER_M), self._coarse.touches
        travel = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)) @ self.reach)]).tolist()
        level, at, narrow = levels - 1, 0, [-1] * levels
        while at < number:
            middle = at if level == 0 else bisect_right(travel, travel[at] + WIDER_M[level]) - 1
            if level and middle == at:
                level -= 1
                continue
            if widely(native[middle], level) if level else self.touches(native[middle]):
                if level == 0:
                    return at
                narrow[level] = middle
                level -= 1
            else:
                at = middle + 1 if level == 0 else bisect_right(travel, travel[middle] + WIDER_M[level])
                if level + 1 < levels and at > narrow[level + 1]:
                    level += 1
        return number

    def line_free(self, a: Vector, b: Vector, resolution: float) -> bool:
        """Whether the straight line from `a`, which is not checked, to `b` is free, both shape (J,).

        Args:
            a: the start.
            b: the end.
            resolution: maximum motion of any point of the arm between two checks [m].
        """
        self.before()
        begin, way = self._still.copy(), np.zeros(len(self._still))
        begin[self._columns] = a - self._reference
        way[self._columns] = b - a
        begin, way = self.arm.followed(begin), self.arm.followed(way, motion=True)
        travel = float(np.abs(b - a) @ self.reach)
        number = max(math.ceil(travel / resolution), 1)
        order, shares = spread(number)
        configurations = begin + shares * way
        if number <= _FEW:
            return not any(map(self.touches, configurations))
        level = min(bisect_right(WIDER_M, travel), len(WIDER_M) - 1)
        proved = bytearray(number)
        for i, q in zip(order, configurations, strict=True):
            if proved[i]:
                continue
            covers = int(WIDER_M[level] / travel * number)
            if covers:
                if not self._coarse.touches(q, level):
                    first, last = max(i - covers, 0), min(i + covers + 1, number)
                    proved[first:last] = b"\1" * (last - first)
                    continue
                level -= 1
            if self.touches(q):
                return False
        return True

    def contacts(self, q: Vector) -> list[Contact]:
        """Contacts closer than their padding at `q`, shape (J,): the closest of each pair of names, deepest first."""
        shapes, results, names = self.geometry, self.results, self._exact.names
        pinocchio.computeCollisions(self.arm.model, self.data, shapes, results, self.native(q[None])[0], False)
        closest: dict[Pair, Contact] = {}
        for number, (pair, result) in enumerate(zip(shapes.collisionPairs, results.collisionResults, strict=True)):
            if not result.isCollision():
                continue
            first, second = names[pair.first], names[pair.second]
            distance = pinocchio.computeDistance(shapes, results, number).min_distance
            padding = self._exact.margins[0][pair.first, pair.second]
            contact = Contact(first, second, float(distance), float(padding))
            known = closest.get((first, second))
            if known is None or contact.distance < known.distance:
                closest[first, second] = contact
        return sorted(closest.values(), key=lambda contact: contact.distance)

    def native(self, configurations: Vector) -> Vector:
        """Configurations of the planned joints, shape (N, J), completed with all other joints for Pinocchio."""
        self.before()
        whole = np.empty((len(configurations), len(self._still)))
        whole[:] = self._still
        whole[:, self._columns] = configurations - self._reference
        return self.arm.followed(whole)

    def touches(self, native: Vector) -> bool:
        """Whether anything is closer than its padding at a configuration in Pinocchio's order."""
        return self._coarse.touches(native) and (self._exact is self._coarse or self._exact.touches(native))


class Clearance:
    """Distances in one world. Not for use by several threads.

    Args:
        arm: the arm.
        world: its objects; those that a link carries belong to the arm.
    """

    def __init__(self, arm: Arm, world: World) -> None:
        self._checks = Collisions(arm, world, arm.joint_names)
        standing = {name for name, thing in world.objects.items() if thing.link is None}
        pairs = enumerate(self._checks.pairs)
        self._pairs = [(number, names) for number, names in pairs if standing.intersection(names)]

    def __call__(self, q: Vector) -> tuple[float, Pair]:
        """Distance from the nearest object [m] at `q`, shape (J,): negative in contact, infinite without objects.

        With the names of the nearest pair.
        """
        checks = self._checks
        native = checks.native(q[None])[0]
        pinocchio.updateGeometryPlacements(checks.arm.model, checks.data, checks.geometry, checks.results, native)
        distance = pinocchio.computeDistance
        return min(
            ((distance(checks.geometry, checks.results, number).min_distance, names) for number, names in self._pairs),
            default=(math.inf, ("", "")),
        )


class Engine:
    """Native checks of shapes, with margins that can be widened.

    Args:
        model: pinocchio.Model.
        data: pinocchio.Data.
        shapes: the shapes, S in number.
        checked: which pairs to check, shape (S, S).
        margins: their least distances [m], shape (S, S).
    """

    def __init__(self, model: Any, data: Any, shapes: Sequence[LinkShape], checked: Flags, margins: Vector) -> None:
        self._model, self._data = model, data
        self.names = [shape.link for shape in shapes]
        self.geometry = pinocchio.GeometryModel()
        for number, shape in enumerate(shapes):
            self.geometry.addGeometryObject(
                pinocchio.GeometryObject(f"{number}", shape.joint, pinocchio.SE3(shape.placement), shape.geometry)
            )
        self.geometry.setCollisionPairs(checked, True)
        self.margins = [margins + width for width in WIDER_M]
        self._set = -1
        """Index of the margins that `results` has."""

    @cached_property
    def results(self) -> Any:
        """pinocchio.GeometryData; one for all margins, since it takes as long to create as a hundred checks."""
        return self.geometry.createData()

    @cached_property
    def _managers(self) -> list[Any]:
        """One manager for each of the margins.

        The naive manager compares all bounding boxes, which is fastest for the few dozen shapes of an arm. It widens
        the boxes by the margins that are set when it is made.
        """
        managers = []
        for level in range(len(WIDER_M)):
            self.widen(level)
            managers.append(pinocchio.BroadPhaseManager_NaiveCollisionManager(self._model, self.geometry, self.results))
        return managers

    def widen(self, level: int) -> None:
        """Set the margins widened by `WIDER_M[level]`."""
        if self._set != level:
            self.results.setSecurityMargins(self.geometry, self.margins[level], True, True)
            self._set = level

    def touches(self, native: Vector, level: int = 0) -> bool:
        """Whether anything is closer than its widened margin at a configuration in Pinocchio's order."""
        manager = self._managers[level]
        if self._set != level:
            self.widen(level)
        return bool(pinocchio.computeCollisions(self._model, self._data, manager, native, True))


@lru_cache(maxsize=1024)
def spread(number: int) -> tuple[list[int], Vector]:
    """Indices 0 to number - 1, each far from the previous ones (van der Corput), and (index + 1) / number of each.

    The shares have shape (number, 1).
    """
    bits = max(number - 1, 1).bit_length()
    codes = np.arange(1 << bits)
    reversed_bits = np.asarray(sum(((codes >> i) & 1) << (bits - 1 - i) for i in range(bits)))
    # The middle comes before the ends.
    order = np.append(reversed_bits[(reversed_bits < number) & (reversed_bits > 0)], 0)
    return order.tolist(), (order[:, None] + 1) / number


def unchecked_pairs(arm: Arm, *, samples: int = _SAMPLES, seed: int = 0, never: bool = False) -> dict[Pair, str]:
    """Pairs of links that need no check, with the reason, found as MoveIt's setup assistant does.

    Args:
        arm: the arm.
        samples: number of random configurations.
        seed: their seed.
        never: whether to add pairs that touch in none of the configurations. That saves little time, and may miss rare
            contacts.
    """
    reasons = dict.fromkeys(arm.adjacent(), ADJACENT)
    checks = Collisions(attrs.evolve(arm, unchecked=reasons), World(), arm.joint_names)
    touching: dict[Pair, int] = {}
    for q in np.random.default_rng(seed).uniform(arm.lower, arm.upper, (samples, len(arm.joint_names))):
        for contact in checks.contacts(q) if not checks.free(q) else ():
            pair = sorted_pair(contact.first, contact.second)
            touching[pair] = touching.get(pair, 0) + 1
    for i, j in arm.pairs():
        pair = sorted_pair(arm.shapes[i].link, arm.shapes[j].link)
        if pair in reasons:
            continue
        if touching.get(pair, 0) >= _ALWAYS_SHARE * samples:
            reasons[pair] = ALWAYS
        elif never and pair not in touching:
            reasons[pair] = NEVER
    return reasons


def object_shapes(arm: Arm, world: World) -> list[LinkShape]:
    """Objects as shapes, each with the link that carries it, if any."""
    shapes = []
    for name, thing in world.objects.items():
        joint, frame = (0, np.eye(4)) if thing.link is None else arm.frame(thing.link)
        several = boxes(thing.shape) if isinstance(thing.shape, Boxes) else [(geometry(thing.shape), np.eye(4))]
        shapes += [LinkShape(name, joint, frame @ matrix(thing.pose) @ within, made) for made, within in several]
    return shapes


def checked_pairs(
    world: World, shapes: Sequence[LinkShape], padding: float, self_padding: float, unchecked: Collection[Pair]
) -> tuple[Flags, Vector]:
    """Which pairs of shapes to check, and their margins [m], both shape (S, S)."""
    names = list(dict.fromkeys(shape.link for shape in shapes))
    numbers = {name: number for number, name in enumerate(names)}
    apart = np.ones((len(names), len(names)), dtype=bool)
    touching = set(unchecked)
    for name, thing in world.objects.items():
        touching.update((name, other) for other in thing.may_touch)
    for first, second in touching:
        if first in numbers and second in numbers:
            apart[numbers[first], numbers[second]] = apart[numbers[second], numbers[first]] = False
    standing = np.array([name in world.objects and world.objects[name].link is None for name in names])
    of = np.array([numbers[shape.link] for shape in shapes], dtype=np.intp)
    joints = np.array([shape.joint for shape in shapes])
    checked = apart[np.ix_(of, of)] & (joints[:, None] != joints[None])
    return checked, np.where(standing[of][:, None] | standing[of][None], padding, self_padding)


class ContactChecks(Protocol):
    """The part of a collision checker that looks at single configurations."""

    def free(self, q: Vector) -> bool:
        """Whether `q`, shape (J,), is free."""

    def contacts(self, q: Vector) -> list[Contact]:
        """Contacts closer than their padding at `q`, shape (J,)."""


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
