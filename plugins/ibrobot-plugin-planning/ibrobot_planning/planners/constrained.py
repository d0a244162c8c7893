"""Search and checks under path constraints.

A configuration that breaks a constraint is treated like one in collision. Trees grow along lines that are projected
onto the constraints, as in CBiRRT (Berenson et al., "Manipulation planning on constraint manifolds", 2009): all points
of a line at once.
"""

from __future__ import annotations

import math
from typing import ClassVar, override

import attrs
import numpy as np
from ibrobot_kinematics import ToolConstraints

from ibrobot_core.api import Vector
from ibrobot_planning.goals.tool import HELD_BACK
from ibrobot_planning.planners.search import Space
from ibrobot_planning.world.collision import Collisions, Contact

_STEP = 0.2
"""Distance of the points of a projected line [rad]."""
_TEAR = 3.0
"""Points of a projected line that are this many steps apart belong to different branches."""
_STILL = 1e-9
_TURN = 0.02
"""Sum of the joints' motions between checks of a constraint on a line [rad or m]."""


class ConstrainedChecks:
    """Checks of configurations for contacts, and for constraints of the tool.

    Args:
        contacts: checks for contacts.
        constraints: the constraints.
        whole: positions of all joints of the model [rad or m], shape (M,); those that are not planned keep them.
        order: index of each planned joint in them, shape (J,).
    """

    def __init__(
        self, contacts: Collisions, constraints: ToolConstraints, whole: Vector,
        order: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    ) -> None:  # fmt: skip
        self._contacts, self.constraints, self._whole, self._order = contacts, constraints, whole, order
        self.reach = contacts.reach
        """As `Collisions.reach`."""

    def whole(self, configurations: Vector) -> Vector:
        """Configurations of the planned joints, shape (…, J), completed with all others, shape (…, M)."""
        self._contacts.before()
        whole = np.empty((*configurations.shape[:-1], len(self._whole)))
        whole[...] = self._whole
        whole[..., self._order] = configurations
        return whole

    def planned(self, whole: Vector) -> Vector:
        """The planned joints, shape (…, J), of all joints, shape (…, M)."""
        return np.asarray(whole[..., self._order])

    def free(self, q: Vector) -> bool:
        """Whether `q`, shape (J,), touches nothing and keeps the constraints."""
        return self.first_broken(q[None]) == 1 and self._contacts.free(q)

    def first_broken(self, configurations: Vector) -> int:
        """Number of configurations, shape (N, J), before the first that breaks a constraint."""
        return self.constraints.first_broken(self.whole(configurations), -HELD_BACK)

    def first_hit(self, configurations: Vector) -> int:
        """Number of configurations, shape (N, J), before the first that is not free."""
        return self._contacts.first_hit(configurations[: self.first_broken(configurations)])

    def first_hit_on_path(self, path: Vector) -> int:
        """As `first_hit`, for a path in small steps; see `Collisions.first_hit_on_path`."""
        return self._contacts.first_hit_on_path(path[: self.first_broken(path)])

    def line_free(self, a: Vector, b: Vector, resolution: float) -> bool:
        """Whether the straight line from `a`, which is not checked, to `b` is free; as `Collisions.line_free`."""
        number = max(math.ceil(float(np.abs(b - a).sum()) / _TURN), 1)
        line = a + (np.arange(1, number + 1) / number)[:, None] * (b - a)
        return self.first_broken(line) == number and self._contacts.line_free(a, b, resolution)

    def contacts(self, q: Vector) -> list[Contact]:
        """As `Collisions.contacts`."""
        return self._contacts.contacts(q)

    def broken(self, q: Vector) -> str:
        """In words, the constraint that `q`, shape (J,), breaks; empty if it keeps all."""
        return self.constraints.broken(self.whole(q), -HELD_BACK)


@attrs.frozen(eq=False)
class ConstrainedSpace(Space):
    """A search space with constraints of the tool. Its trees grow along curves."""

    constrained: ConstrainedChecks = attrs.field(kw_only=True)
    """The same as `checks`."""

    straight: ClassVar[bool] = False

    @override
    def kept(self, configurations: Vector) -> Vector:
        checks = self.constrained
        near, done = checks.constraints.projected(checks.whole(configurations))
        return checks.planned(near[done])

    @override
    def curve(self, a: Vector, b: Vector, longest: float = math.inf) -> Vector:
        """Points along the projection of the line from `a` towards `b`; as `Space.curve`."""
        checks, way = self.constrained, b - a
        length = float(np.linalg.norm(way))
        if length > longest:
            way, length = way * (longest / length), longest
        number = max(math.ceil(length / _STEP), 1)
        line = a + (np.arange(1, number + 1) / number)[:, None] * way
        near, done = checks.constraints.projected(checks.whole(line))
        points, before = checks.planned(near), a
        for i, point in enumerate(points):
            apart = float(np.linalg.norm(point - before))
            if not done[i] or apart > _TEAR * length / number + _STILL or not self.free(before, point):
                return points[:i]
            before = point
        return points
