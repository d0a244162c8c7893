"""Collision checks: exact padding, carried objects, the base, and MuJoCo's own distances."""

from __future__ import annotations

from itertools import pairwise

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_kinematics.poses import pose, pose_at
from ibrobot_planning.world.arm import ADJACENT, ALWAYS, Arm, read_arm
from ibrobot_planning.world.collision import Collisions, unchecked_pairs
from ibrobot_planning.world.objects import Box, Capsule, Cylinder, Mesh, Plane, Sphere, World, WorldObject
from ibrobot_planning.world.voxels import voxels

from ibrobot_core.api import PlanCode, PlanningError, Pose, Vector3

from .table_arm import ARM, JOINTS, box, write_arm

UP = np.zeros(5)
CORNERS = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip
BLOCK = np.stack(np.meshgrid(*[np.arange(-0.095, 0.1, 0.01)] * 3), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Arm:
    return read_arm(write_arm(tmp_path_factory.mktemp("arm")), JOINTS)


SHAPES = {
    "box": Box((0.2, 0.2, 0.2)),
    "sphere": Sphere(0.1),
    "cylinder": Cylinder(0.1, 0.2),
    "capsule": Capsule(0.05, 0.1),
    "mesh": Mesh(CORNERS, FACES),
    "hull": Mesh(CORNERS, FACES, convex=True),
    "voxels": voxels(BLOCK, 0.01),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_padding_is_a_distance(arm, shape):
    round_end = shape.radius if isinstance(shape, Sphere | Capsule) else 0.0
    for gap, free in ((0.0055, True), (0.0045, False)):
        # The hand's top ends at x = -0.008, where a round end is nearest to it.
        lowest = np.sqrt((round_end + gap) ** 2 - 0.008**2) - round_end if round_end else gap
        place = Pose(Vector3(0, 0, 0.465 + lowest + 0.1))
        checks = Collisions(arm, World({"thing": WorldObject(shape, place)}), ARM, padding=0.005)
        contacts = [contact for contact in checks.contacts(UP) if "thing" in (contact.first, contact.second)]
        assert bool(contacts) is not free
        if contacts:
            assert contacts[0].distance == pytest.approx(gap, abs=1e-4)
            assert str(contacts[0]).startswith("hand is 4.5 mm from thing, with 5.0 mm asked")


def checked(arm: Arm) -> Arm:
    """The arm without checks of links that always touch."""
    return attrs.evolve(arm, unchecked=unchecked_pairs(arm))


def test_a_plane_is_solid_below(arm):
    checks = Collisions(arm, World({"ceiling": WorldObject(Plane(), pose_at((0, 0, 0.5), (np.pi, 0, 0)))}), ARM)
    assert not any("ceiling" in (each.first, each.second) for each in checks.contacts(UP))
    floor = World({"floor": WorldObject(Plane(), Pose(Vector3(0, 0, 0.3)))})
    assert any(each.second == "floor" for each in Collisions(arm, floor, ARM).contacts(UP))


def test_the_base_has_the_hull_of_its_visible_mesh(arm):
    assert "base" in {shape.link for shape in arm.shapes}
    folded = np.array([0.0, 1.8, 2.2, 1.2, 0.0])
    checks = Collisions(checked(arm), World(), ARM)
    contacts = {(each.first, each.second) for each in checks.contacts(folded)}
    assert any("base" in pair for pair in contacts)


def test_unchecked_pairs_are_adjacent_or_touch_always(arm):
    found = unchecked_pairs(arm)
    assert found["base", "turret"] == ADJACENT
    assert found["lower", "wrist"] == ADJACENT
    assert ("base", "hand") not in found
    assert set(found.values()) <= {ADJACENT, ALWAYS}
    assert found == unchecked_pairs(arm)
    assert unchecked_pairs(arm, never=True).keys() > found.keys()


def test_only_the_base_of_its_own_arm_is_connected_with_a_turret(tmp_path):
    """The other arm's base stands, too, and the turret can meet it."""
    places = (("left_", (0.0, 0.2, 0.0, 0.0)), ("right_", (0.0, -0.2, 0.0, 0.0)))
    joints = tuple(f"{prefix}{name}" for prefix, _ in places for name in JOINTS)
    connected = read_arm(write_arm(tmp_path), joints, places).adjacent()
    assert ("left_base", "left_turret") in connected
    assert ("right_base", "right_turret") in connected
    assert {pair for pair in connected if pair[0][:5] != pair[1][:5]} == set()


def test_what_may_touch_is_not_checked(arm):
    thing = box(0, 0, 0.46, 0.1, 0.1, 0.02)
    assert not Collisions(checked(arm), World({"thing": thing}), ARM).free(UP)
    touching = WorldObject(thing.shape, thing.pose, may_touch={"hand", "finger"})
    assert Collisions(checked(arm), World({"thing": touching}), ARM).free(UP)


def test_carried_objects_move_with_their_link_and_collide(arm):
    arm = checked(arm)
    stick = WorldObject(Box((0.02, 0.02, 0.2)), pose(arm.link_pose("hand", np.zeros(6))))
    world = World({"stick": stick, "post": box(0, 0.25, 0.2, 0.02, 0.02, 0.4)})
    held = world.attach("stick", "hand", Pose(Vector3(0, 0, 0.12)), frozenset({"finger", "wrist"}))
    out = np.array([np.pi / 2, np.pi / 2, 0, 0, 0])
    low = np.array([0.9, np.pi / 2, 0, 0, 0])
    free = Collisions(arm, held, ARM)
    assert free.free(UP)
    assert free.free(low)
    reaching = Collisions(arm, held.move("post", Pose(Vector3(0, 0.5, 0.1))), ARM)
    assert [(each.first, each.second) for each in reaching.contacts(out)] == [("stick", "post")]
    without = Collisions(arm, held.remove("stick").move("post", Pose(Vector3(0, 0.5, 0.1))), ARM)
    assert without.free(out)
    assert (reaching.reach > without.reach).all()


def test_joints_that_are_not_planned_stand_where_they_are_said_to_be(arm):
    beside = World({"ball": WorldObject(Sphere(0.01), Pose(Vector3(0.045, 0, 0.445)))})
    names = [
        {each.first for each in Collisions(arm, beside, ARM, {"jaw": jaw}).contacts(UP) if each.second == "ball"}
        for jaw in (0.0, 0.9)
    ]
    assert names == [set(), {"finger"}]


OBJECTS = (
    '<geom name="o1" type="box" pos=".2 0 .2" size=".05 .04 .03"/>'
    '<geom name="o2" type="cylinder" pos="-.15 .1 .15" size=".03 .1"/>'
    '<geom name="o3" type="sphere" pos="0 -.2 .25" size=".06"/>'
    '<geom name="o4" type="capsule" pos="0 .22 .3" size=".02 .05"/>'
)
WORLD = World(
    {
        "o1": WorldObject(Box((0.1, 0.08, 0.06)), Pose(Vector3(0.2, 0, 0.2))),
        "o2": WorldObject(Cylinder(0.03, 0.2), Pose(Vector3(-0.15, 0.1, 0.15))),
        "o3": WorldObject(Sphere(0.06), Pose(Vector3(0, -0.2, 0.25))),
        "o4": WorldObject(Capsule(0.02, 0.1), Pose(Vector3(0, 0.22, 0.3))),
    }
)


@pytest.mark.skipif(
    tuple(map(int, mujoco.__version__.split(".")[:2])) < (3, 12),
    reason="mj_geomDistance of older versions misses deep contacts",
)
def test_free_is_what_mujoco_measures(arm, tmp_path):
    model = mujoco.MjModel.from_xml_path(str(write_arm(tmp_path, OBJECTS)))
    data = mujoco.MjData(model)
    objects = [model.geom(f"o{i}").id for i in range(1, 5)]
    links = [i for i in range(model.ngeom) if model.geom_bodyid[i] and model.geom_contype[i]]
    arm = attrs.evolve(arm, unchecked={(a, b): "" for a in arm.frames for b in arm.frames})
    checks = Collisions(arm, WORLD, JOINTS, padding=0.005)
    compared = 0
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (300, 6)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        distance = min(mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in links for b in objects)
        if abs(distance - 0.005) > 1e-4:
            compared += 1
            assert checks.free(q) == (distance > 0.005)
            contacts = checks.contacts(q)
            if 0 < distance < 0.005:
                assert contacts[0].distance == pytest.approx(distance, abs=1e-5)
    assert compared > 290


def test_wide_margins_find_the_same_first_hit_on_a_path_as_checks_of_every_configuration(arm):
    checks = Collisions(checked(arm), WORLD, ARM, padding=0.005)
    rng = np.random.default_rng(1)
    hits = []
    for _ in range(60):
        corners = rng.uniform(arm.lower[:5], arm.upper[:5], (3, 5))
        path = np.concatenate([np.linspace(a, b, 150) for a, b in pairwise(corners)])
        path = path[checks.first_hit(path[:1]) == 0 :]
        hits.append(checks.first_hit(path) / len(path))
        assert checks.first_hit_on_path(path) == checks.first_hit(path)
    assert min(hits) < 0.2
    assert max(hits) == 1


def test_lines_are_free_where_all_of_their_configurations_are(arm):
    checks = Collisions(checked(arm), WORLD, ARM, padding=0.005)
    rng = np.random.default_rng(2)
    answers = []
    for a, b in rng.uniform(arm.lower[:5], arm.upper[:5], (120, 2, 5)):
        number = int(np.ceil(np.abs(b - a) @ checks.reach / 0.002))
        answers.append(checks.line_free(a, b, 0.002))
        assert answers[-1] == (checks.first_hit(np.linspace(a, b, number + 1)[1:]) == number)
        # Coarser checks may miss a contact, but find none that is not there.
        assert checks.line_free(a, b, 0.05) >= answers[-1]
    assert 10 < sum(answers) < 110


def test_unknown_names_are_refused(arm):
    for make, message, code in (
        (lambda: Collisions(arm, World(), ("pan", "knee")), "no joint 'knee'", PlanCode.INVALID_GROUP_NAME),
        (lambda: Collisions(arm, World(), ARM, {"knee": 0.0}), "no joint 'knee'", PlanCode.INVALID_GROUP_NAME),
        (
            lambda: Collisions(arm, World({"a": WorldObject(Sphere(0.1), link="foot")}), ARM),
            "no link 'foot'; the links are: world, base, turret",
            PlanCode.INVALID_LINK_NAME,
        ),
        (
            lambda: World({"a": WorldObject(Sphere(0.1), may_touch={"table"})}).check(arm.frames, ()),
            "object 'a' may touch 'table', which is neither a link nor an object",
            PlanCode.INVALID_LINK_NAME,
        ),
        (
            lambda: Collisions(arm, World({"hand": WorldObject(Sphere(0.1))}), ARM),
            "an object has the name of link 'hand'",
            PlanCode.INVALID_OBJECT_NAME,
        ),
        (lambda: arm.link_pose("foot", np.zeros(6)), "no link 'foot'", PlanCode.INVALID_LINK_NAME),
    ):
        with pytest.raises(PlanningError, match=message) as caught:
            make()
        assert caught.value.code is code


def test_models_that_cannot_be_used_are_refused(tmp_path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><body></worldbody></mujoco>")
    bare = tmp_path / "bare.xml"
    bare.write_text(
        '<mujoco><worldbody><body><joint name="a" range="-1 1"/><inertial pos="0 0 0" mass="1" '
        'diaginertia="1 1 1"/></body></worldbody></mujoco>'
    )
    for path, joints, message in (
        (tmp_path / "none.xml", ("a",), "none.xml: cannot be read: No such file"),
        (broken, ("a",), "broken.xml:1: not valid XML: mismatched tag"),
        (bare, ("b",), "no joint 'b'; it has: a"),
        (bare, ("a",), "no geometry that could collide"),
    ):
        with pytest.raises(PlanningError, match=message) as caught:
            read_arm(path, joints)
        assert caught.value.code is PlanCode.COLLISION_CHECKING_UNAVAILABLE
