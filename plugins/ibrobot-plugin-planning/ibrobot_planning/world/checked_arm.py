"""A robot's arm for collision checks: pairs of links that need none, and hulls that make the others quick.

What does not touch the convex hull of a link does not touch the shapes in it.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType

import attrs
import numpy as np
from ibrobot_kinematics.srdf import read_srdf
from ibrobot_kinematics.urdf import Urdf, read_urdf

from ibrobot_core.api import Robot
from ibrobot_planning.world.arm import SRDF, Arm, LinkShape, Pair, robot_arm, sorted_pair
from ibrobot_planning.world.coal_shapes import enclosing, hull
from ibrobot_planning.world.collision import Collisions, unchecked_pairs
from ibrobot_planning.world.objects import World

_SAMPLES = 200
"""Random configurations that decide which hulls make checks faster."""
_MADE: deque[tuple[Robot, Arm]] = deque(maxlen=2)
"""The newest models, each with its robot."""
_MAKING = threading.Lock()
_VAIN_SHARE = 0.05
"""A link keeps its shapes if its hull touches another link in more of the free configurations."""


def checked_arm(robot: Robot, log: logging.Logger) -> Arm:
    """The collision model of a robot, from its MJCF, URDF and SRDF. It takes seconds to make: users share it.

    Raises:
        PlanningError: as `robot_arm`.
        KinematicsError: for a URDF or SRDF that cannot be read.
    """
    with _MAKING:
        made = next((arm for known, arm in _MADE if known is robot), None)
        if made is None:
            made = _made(robot, log)
            _MADE.append((robot, made))
        return made


def _made(robot: Robot, log: logging.Logger) -> Arm:
    return with_hulls(may_touch_arm(robot, log))


def may_touch_arm(robot: Robot, log: logging.Logger) -> Arm:
    """The collision model of a robot with the pairs of links that may touch, without hulls.

    Raises:
        PlanningError: as `robot_arm`.
        KinematicsError: for a URDF or SRDF that cannot be read.
    """
    arm = robot_arm(robot)
    arm = attrs.evolve(arm, unchecked=_unchecked(arm))
    if robot.description.urdf is None:
        return arm
    urdf = read_urdf(robot.description.urdf)
    links = {name: link for link, name in urdf_names(arm, urdf).items()}
    unchecked = dict(arm.unchecked)
    srdf = read_srdf(robot.description.srdf, urdf) if robot.description.srdf is not None else None
    for pair in srdf.may_touch if srdf is not None else ():
        unknown = [name for name in pair if name not in links]
        if unknown:
            message = "%s: %s and %s are checked nevertheless: no joint of the MJCF carries %s"
            log.warning(message, robot.description.srdf, *pair, unknown[0])
        else:
            unchecked[sorted_pair(links[pair[0]], links[pair[1]])] = SRDF
    return attrs.evolve(arm, unchecked=unchecked, urdf_links=links)


@lru_cache(maxsize=4)
def _unchecked(arm: Arm) -> Mapping[Pair, str]:
    """`unchecked_pairs`, which takes a thousand checks: a run asks for its guard and for its planner."""
    return MappingProxyType(unchecked_pairs(arm))


def urdf_names(arm: Arm, urdf: Urdf) -> dict[str, str]:
    """Link of the MJCF -> link of the URDF that the same joint carries; also the base."""
    children = {joint.name: joint.child for joint in urdf.joints}
    names: dict[str, str] = {}
    named: set[int] = set()
    for link, (joint, _) in arm.frames.items():
        # The first link of a joint, from the base outwards, is its child; others are fixed to it.
        if link == "world" or joint in named:
            continue
        named.add(joint)
        if joint == 0:
            names[link] = urdf.root
        elif (name := arm.model.names[joint]) in children:
            names[link] = children[name]
    return names


def with_hulls(arm: Arm) -> Arm:
    """The arm with one hull in place of the shapes of each link, if that makes checks faster."""
    checks = Collisions(arm, World(), arm.joint_names)
    samples = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_SAMPLES, len(arm.joint_names)))
    free = [q for q in samples if checks.free(q)]
    of_links: dict[str, list[LinkShape]] = {}
    for shape in arm.shapes:
        of_links.setdefault(shape.link, []).append(shape)
    hulls: dict[str, Sequence[LinkShape]] = {link: link_hulls(shapes) for link, shapes in of_links.items()}
    while True:
        few = tuple(shape for shapes in hulls.values() for shape in shapes)
        if len(few) == len(arm.shapes):
            return arm
        coarse = Collisions(attrs.evolve(arm, shapes=few), World(), arm.joint_names)
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
        # Only the worst hull is dropped: without it, the others may do.
        _, link = max(vain)
        hulls[link] = of_links[link]


def link_hulls(shapes: Sequence[LinkShape]) -> Sequence[LinkShape]:
    """One shape that contains the convex shapes of a link, and the others."""
    points, others = [], []
    for shape in shapes:
        corners = enclosing(shape.geometry)
        if corners is None:
            others.append(shape)
        else:
            points.append(corners @ shape.placement[:3, :3].T + shape.placement[:3, 3])
    if len(points) < 2:
        return shapes
    return [
        LinkShape(shapes[0].link, shapes[0].joint, np.eye(4), hull(np.concatenate(points)), shapes[0].tree),
        *others,
    ]
