"""Hulls of links: quick checks with the answers of the exact ones."""

from __future__ import annotations

from itertools import pairwise

import attrs
import numpy as np
import pytest
from ibrobot_planning.world.arm import Arm, read_arm
from ibrobot_planning.world.checked_arm import with_hulls
from ibrobot_planning.world.collision import Collisions, unchecked_pairs
from ibrobot_planning.world.objects import Cylinder, Sphere, World, WorldObject

from ibrobot_core.api import Pose, Vector3

from .table_arm import ARM, JOINTS, MJCF, box

FORKED = MJCF.replace(
    '<site name="tip"',
    '<geom type="box" pos=".06 0 .03" size=".004 .01 .025"/><geom type="box" pos=".024 0 .01" size=".03 .01 .004"/>'
    '<geom type="cylinder" pos="-.03 0 .03" size=".01 .01"/><site name="tip"',
).replace('contype="0" conaffinity="0"/>', "/>")
"""The hand is a fork."""
POSTS = FORKED.replace(
    '<body name="base">',
    '<body name="base"><geom type="box" pos=".2 0 .3" size=".01 .01 .2"/>'
    '<geom type="box" pos="-.2 0 .3" size=".01 .01 .2"/>',
)
"""The arm moves between two posts of its base."""


def make(tmp_path_factory, mjcf: str) -> Arm:
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(mjcf.format(objects=""))
    return read_arm(path, JOINTS)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Arm:
    arm = make(tmp_path_factory, FORKED)
    return with_hulls(attrs.evolve(arm, unchecked=unchecked_pairs(arm)))


@pytest.fixture(scope="module")
def both(arm) -> tuple[Collisions, Collisions]:
    """Checks with and without hulls, among objects."""
    can = WorldObject(Cylinder(0.03, 0.2), Pose(Vector3(-0.15, 0.1, 0.15)))
    world = World({"wall": box(0.2, 0, 0.15, 0.3, 0.02, 0.3), "can": can, "lid": box(0, 0, 0.45, 0.05, 0.05, 0.02)})
    quick, exact = (Collisions(each, world, ARM, padding=0.005) for each in (arm, attrs.evolve(arm, hulls=())))
    return quick, exact


def test_links_of_several_shapes_have_one_hull(arm):
    assert [shape.link for shape in arm.hulls] == ["base", "turret", "upper", "lower", "wrist", "hand", "finger"]
    assert len(arm.shapes) == 10


def test_what_is_between_the_prongs_does_not_touch(arm):
    place = arm.link_pose("hand", np.zeros(6)) @ [0.042, 0, 0.05, 1]
    ball = World({"ball": WorldObject(Sphere(0.005), Pose(Vector3(*place[:3])))})
    checks = Collisions(arm, ball, ARM, padding=0.002)
    assert checks.free(np.zeros(5))
    moved = Collisions(arm, ball.move("ball", Pose(Vector3(place[0] + 0.008, *place[1:3]))), ARM, padding=0.002)
    assert ("hand", "ball") in {(each.first, each.second) for each in moved.contacts(np.zeros(5))}
    assert not moved.free(np.zeros(5))


def test_answers_are_those_of_the_exact_shapes(both):
    quick, exact = both
    samples = np.random.default_rng(0).uniform(quick.arm.lower[:5], quick.arm.upper[:5], (300, 5))
    free = [exact.free(q) for q in samples]
    assert 50 < sum(free) < 250
    assert [quick.free(q) for q in samples] == free
    begins = samples[free]
    lines = [(a, b, exact.line_free(a, b, 0.01)) for a, b in pairwise(begins)]
    assert 5 < sum(result for *_, result in lines) < len(lines) - 5
    for a, b, result in lines:
        assert quick.line_free(a, b, 0.01) == result
        path = np.linspace(a, b, 100)
        assert quick.first_hit_on_path(path) == exact.first_hit(path)


def test_link_keeps_shapes_where_its_hull_contains_the_arm(tmp_path_factory):
    arm = make(tmp_path_factory, POSTS)
    arm = with_hulls(attrs.evolve(arm, unchecked=unchecked_pairs(arm)))
    links = [shape.link for shape in arm.hulls]
    assert links.count("base") == 3
    assert links.count("hand") == 1


def test_arm_with_one_shape_per_link_needs_no_hulls(tmp_path_factory):
    arm = make(tmp_path_factory, MJCF)
    assert with_hulls(arm) is arm
