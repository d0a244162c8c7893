"""Convex hulls of links, for quick checks: where nothing touches the hulls, nothing touches the shapes in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import attrs
import numpy as np

from ibrobot_planning.world.arm import Arm, LinkShape, Pair
from ibrobot_planning.world.coal_shapes import enclosing, hull
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import World

_SAMPLES = 200
"""Number of configurations that determine which hulls are of use."""
_VAIN_SHARE = 0.05
"""A link whose hull touches another link in more of the free configurations keeps its shapes."""


def with_hulls(arm: Arm, unchecked: Collection[Pair]) -> Arm:
    """The arm with one hull in place of the shapes of each link, where that is of use.

    Args:
        arm: the arm.
        unchecked: pairs of links that may touch.
    """
    checks = Collisions(arm, World(), arm.joint_names, unchecked=unchecked)
    samples = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_SAMPLES, len(arm.joint_names)))
    free = [q for q in samples if checks.free(q)]
    of_links: dict[str, list[LinkShape]] = {}
    for shape in arm.shapes:
        of_links.setdefault(shape.link, []).append(shape)
    hulls: dict[str, Sequence[LinkShape]] = {link: _hulls(shapes) for link, shapes in of_links.items()}
    while True:
        few = tuple(shape for shapes in hulls.values() for shape in shapes)
        if len(few) == len(arm.shapes):
            return arm
        coarse = Collisions(attrs.evolve(arm, shapes=few), World(), arm.joint_names, unchecked=unchecked)
        touching = Counter(
            link for q in free for link in {name for each in coarse.contacts(q) for name in (each.first, each.second)}
        )
        vain = [
            (number, link)
            for link, number in touching.items()
            if number > _VAIN_SHARE * len(free) and len(hulls[link]) < len(of_links[link])
        ]
        if not vain:
            return attrs.evolve(arm, hulls=few)
        # The link that touches most is at fault; the others may be good without it.
        _, link = max(vain)
        hulls[link] = of_links[link]


def _hulls(shapes: Sequence[LinkShape]) -> Sequence[LinkShape]:
    """One shape that contains the shapes of a link; shapes that are not convex stay."""
    points, others = [], []
    for shape in shapes:
        corners = enclosing(shape.geometry)
        if corners is None:
            others.append(shape)
        else:
            points.append(corners @ shape.placement[:3, :3].T + shape.placement[:3, 3])
    if len(points) < 2:
        return shapes
    return [LinkShape(shapes[0].link, shapes[0].joint, np.eye(4), hull(np.concatenate(points))), *others]
