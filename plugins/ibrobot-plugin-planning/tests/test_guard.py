"""The guard `clearance`: commands of every kind keep the arm clear, as MuJoCo's own collision detection sees it."""

from __future__ import annotations

import copy
import itertools
import json
import logging
import math
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import attrs
import mujoco
import numpy as np
import pinocchio
import pytest
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.clearance_guard import ClearanceGuard
from ibrobot_planning.guard.feed import GuardFeed
from ibrobot_planning.guard.options import ClearanceGuardOptions, RegionOptions
from ibrobot_planning.guard.pairs import Pairs
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.checked_arm import may_touch_arm
from ibrobot_planning.world.objects import (
    OBSERVED,
    Box,
    Boxes,
    Mesh,
    ObservedWorld,
    Plane,
    Sphere,
    Voxels,
    World,
    WorldObject,
)

from ibrobot_core.api import Clock, Context, HardwareError, Pose, RealClock, Robot, SteppedClock, Vector, Vector3, ns
from ibrobot_core.app import Bus
from ibrobot_core.control.safety import SafetyLayer

from .table_arm import JOINTS, MJCF, box, make_robot

PERIOD_NS = 10_000_000
FLOOR = '<geom name="floor" type="plane" size="1 1 .1"/>'
POSTS = {"post": box(0.16, 0.0, 0.1, 0.03, 0.03, 0.2), "wall": box(-0.2, 0.0, 0.2, 0.02, 0.6, 0.4)}
MARGIN_M = 0.003


def few(values: range, every: int) -> list[Any]:
    """Parameters that differ in number, not in kind; but for each of so many, they are long."""
    return [pytest.param(each, marks=[pytest.mark.long] if i % every else []) for i, each in enumerate(values)]


class Loop:
    """The safety layer with the guard, in ticks; the joints follow exactly unless `measured` is given."""

    def __init__(
        self,
        folder: Path,
        at: Vector | None = None,
        *,
        guarded: bool = True,
        clock: Clock | None = None,
        described: dict[str, Any] | None = None,
        period_ns: int = PERIOD_NS,
        **options: Any,
    ) -> None:
        robot: Robot = make_robot(folder)
        self.robot = attrs.evolve(robot, description=attrs.evolve(robot.description, **(described or {})))
        context = Context(
            "guard", clock or SteppedClock(7), logging.getLogger("test"), self.robot, self.robot.joint_names, period_ns
        )
        self.guard = ClearanceGuard(
            ClearanceGuardOptions(**{"margin": MARGIN_M, "self_margin": MARGIN_M, **options}), context
        )
        self.safety = SafetyLayer(self.robot, period_ns, self.guard if guarded else None)
        self.position = np.zeros(len(JOINTS)) if at is None else at
        self.safety.activate(self.position)

    def world(self, objects: dict[str, WorldObject], *removed: str, stale: str = "") -> None:
        self.guard.world(WorldChange(objects, removed, stale).message())

    def tick(self, wanted: Vector, measured: Vector | None = None) -> Vector:
        self.position = self.safety.apply(wanted, self.position if measured is None else measured)
        return self.position

    def go(self, wanted: Vector, ticks: int = 120) -> Vector:
        for _ in range(ticks):
            self.tick(wanted)
        return self.position


class Seen:
    """MuJoCo's own view of the arm among objects, with the distance that it sees at each configuration."""

    def __init__(self, objects: dict[str, WorldObject], floor: bool = False) -> None:
        geoms = FLOOR if floor else ""
        for name, thing in objects.items():
            p = thing.pose.position
            assert isinstance(thing.shape, Box)
            half = " ".join(str(length / 2) for length in thing.shape.size)
            geoms += f'<geom name="{name}" type="box" size="{half}" pos="{p.x} {p.y} {p.z}"/>'
        spec = mujoco.MjSpec.from_string(MJCF.format(objects=geoms))
        for geom in spec.geoms:
            geom.margin = 0.05  # contacts are listed from this distance on
        spec.body("base").first_geom().contype = 1  # as planning sees it: its visible shape
        spec.add_exclude(bodyname1="base", bodyname2="turret")  # a joint connects them
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.joints = [int(self.model.joint(name).qposadr[0]) for name in JOINTS]

    def distance(self, q: Vector) -> float:
        self.data.qpos[self.joints] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return float(self.data.contact.dist.min()) if self.data.ncon else 0.05

    def along(self, a: Vector, b: Vector, parts: int = 4) -> float:
        """The least distance on the straight way between two commands."""
        return min(self.distance(a + share * (b - a)) for share in np.linspace(1 / parts, 1, parts))


def random_targets(robot: Robot, rng: np.random.Generator) -> Iterator[Vector]:
    while True:
        target = rng.uniform(robot.lower, robot.upper)
        yield from itertools.repeat(target, int(rng.integers(1, 60)))


def bang_bang(robot: Robot, rng: np.random.Generator) -> Iterator[Vector]:
    while True:
        target = np.where(rng.random(len(robot.joints)) < 0.5, robot.lower, robot.upper)
        yield from itertools.repeat(target, int(rng.integers(1, 80)))


def walk(robot: Robot, rng: np.random.Generator) -> Iterator[Vector]:
    at = np.zeros(len(robot.joints))
    while True:
        at = np.clip(at + rng.normal(scale=0.05, size=len(at)), robot.lower, robot.upper)
        yield at


def down(robot: Robot, rng: np.random.Generator) -> Iterator[Vector]:
    """Folded towards the table, its own base and the post, by turns."""
    poses = [(0, 1.8, 1.2, 1.2, 0, 0), (0, 1.8, -1.5, 0, 1, 1), (0, 1.4, 2.2, 1.8, -1, 0), (0.1, 1.2, 0.6, 0.3, 0, 1.2)]
    while True:
        target = np.array(poses[rng.integers(len(poses))], dtype=float) + rng.normal(scale=0.1, size=6)
        yield from itertools.repeat(target, int(rng.integers(20, 90)))


def switching(robot: Robot, rng: np.random.Generator) -> Iterator[Vector]:
    """One commander after the other, each from where it is."""
    commanders = [each(robot, rng) for each in (random_targets, bang_bang, walk, down)]
    while True:
        yield from itertools.islice(commanders[rng.integers(len(commanders))], int(rng.integers(1, 30)))


COMMANDERS = (random_targets, bang_bang, walk, down, switching)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("commander", COMMANDERS)
def test_no_command_touches_anything(tmp_path, commander, seed: int) -> None:
    loop = Loop(tmp_path, floor=0.0, may_touch={"floor": ("base", "turret")})
    loop.world(POSTS)
    seen, rng = Seen(POSTS, floor=True), np.random.default_rng(seed)
    nearest, before = 1.0, loop.position
    for wanted in itertools.islice(commander(loop.robot, rng), 500):
        loop.tick(wanted)
        nearest = min(nearest, seen.along(before, loop.position))
        before = loop.position
    assert nearest > MARGIN_M - 0.001
    assert commander is walk or loop.guard.counts["ticks"] > 0


def test_without_the_guard_the_same_commands_touch(tmp_path) -> None:
    loop = Loop(tmp_path, guarded=False)
    seen, nearest, before = Seen(POSTS, floor=True), 1.0, loop.position
    for wanted in itertools.islice(down(loop.robot, np.random.default_rng(0)), 300):
        loop.tick(wanted)
        nearest = min(nearest, seen.along(before, loop.position))
        before = loop.position
    assert nearest < -0.01


def test_a_harmless_command_passes_bit_by_bit(tmp_path) -> None:
    guarded, alone = Loop(tmp_path), Loop(tmp_path, guarded=False)
    for wanted in itertools.islice(walk(guarded.robot, np.random.default_rng(1)), 150):
        assert guarded.tick(wanted * 0.3).tobytes() == alone.tick(wanted * 0.3).tobytes()
    assert guarded.guard.overruled == ""


LEFT, ACROSS = np.array([1.0, 1.2, 0.6, 0.3, 0.0, 0.0]), np.array([-1.0, 1.2, 0.6, 0.3, 0.0, 0.0])
WALL = {"wall": box(0.35, 0.0, 0.15, 0.4, 0.02, 0.3)}


def test_joints_that_lead_no_nearer_go_on(tmp_path) -> None:
    loop = Loop(tmp_path, LEFT)
    loop.world(WALL)
    wanted = ACROSS.copy()
    wanted[4] = 1.0
    at = loop.go(wanted)
    assert "wall" in json.loads(loop.guard.overruled).values()
    assert 0.0 < at[0] < LEFT[0] - 0.3, "it has come near the wall, and stopped there"
    assert at[4] == pytest.approx(1.0), "the roll does not lead nearer"
    assert loop.go(LEFT) == pytest.approx(LEFT), "the way back is free"
    assert loop.guard.overruled == ""


@pytest.mark.parametrize("seed", few(range(12), 4))
def test_from_near_anything_the_way_out_is_free(tmp_path, seed: int) -> None:
    """Wherever a command has led, the way that it came is free, and so is the pose above."""
    loop = Loop(tmp_path, floor=0.0, may_touch={"floor": ("base", "turret")})
    loop.world(POSTS)
    rng = np.random.default_rng(seed)
    start = np.array([rng.uniform(-0.4, 0.4), 0.3, 0.3, 0.2, 0.0, 0.3])
    loop.go(start)
    before = loop.position
    way = [loop.tick(wanted) for wanted in itertools.islice(down(loop.robot, rng), 120)]
    loop.go(loop.position, 20)
    for at in reversed(way):
        loop.tick(at)
    assert np.abs(loop.go(before, 200) - before).max() < 0.05


def test_from_a_start_in_contact_only_the_way_out_is_free(tmp_path) -> None:
    start = np.array([0.05, 1.2, 0.6, 0.3, 0.0, 0.0])
    loop = Loop(tmp_path, start)
    loop.world(WALL)
    seen = Seen(WALL)
    depth = seen.distance(start)
    assert depth < 0
    loop.go(ACROSS)
    assert seen.distance(loop.position) > depth - 0.001, "not further in"
    assert loop.go(LEFT) == pytest.approx(LEFT)
    loop.go(ACROSS)
    assert seen.distance(loop.position) > MARGIN_M - 0.001, "and not back in"


def test_a_pair_that_was_nearer_once_is_measured_until_it_has_parted(tmp_path) -> None:
    """So that its limit rises, and it does not come back."""
    seen, clear, inside = Seen(WALL), LEFT, (LEFT + ACROSS) / 2
    for _ in range(30):
        at = (clear + inside) / 2
        clear, inside = (at, inside) if seen.distance(at) > 0.002 else (clear, at)
    arm = may_touch_arm(make_robot(tmp_path), logging.getLogger("test"))
    pairs = Pairs(arm, World(WALL), margin=MARGIN_M, self_margin=MARGIN_M, pressed={})
    near = np.flatnonzero(pairs.distances(clear, np.arange(len(pairs.names))) < MARGIN_M)
    pairs.limits[near] = 0.0005
    nothing = np.zeros(len(JOINTS))
    assert len(near)
    assert set(near) <= set(pairs.unproved(clear, clear, nothing))
    pairs.required(clear, near, nothing)
    assert pairs.limits[near].min() > 0.0019


@pytest.mark.parametrize("seed", few(range(10), 3))
def test_an_object_that_appears_is_stopped_in_front_of(tmp_path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    loop, seen = Loop(tmp_path, LEFT), Seen(WALL)
    for _ in range(int(rng.integers(1, 30))):
        loop.tick(ACROSS)
    room = seen.distance(loop.safety.rest)
    loop.world(WALL)
    nearest, before = 1.0, loop.position
    for _ in range(100):
        nearest, before = min(nearest, seen.along(before, loop.tick(ACROSS))), loop.position
    assert nearest > min(room, MARGIN_M) - 0.001, "never nearer than braking at once would have led"
    assert "wall" in json.loads(loop.guard.overruled).values()


def test_what_may_be_touched_is_pressed_so_deep_and_no_deeper(tmp_path) -> None:
    touching = {"floor": ("base", "turret", "hand", "finger")}
    seen = Seen({}, floor=True)
    for press in (0.005, 0.02):
        loop = Loop(tmp_path, floor=0.0, may_touch=touching, press=press)
        loop.go(np.array([0.0, 1.4, 1.2, 0.5, 0.0, 0.0]))
        assert -press - 0.001 < seen.distance(loop.position) < -press + 0.002


def test_permissions_of_the_world_count(tmp_path) -> None:
    loop = Loop(tmp_path, LEFT)
    links = ("upper", "lower", "wrist", "hand", "finger")
    loop.world({"wall": attrs.evolve(WALL["wall"], may_touch=links)})
    assert loop.go(ACROSS) == pytest.approx(ACROSS)


def reached(loop: Loop, thing: WorldObject) -> bool:
    """Whether commands lead the arm across where the object stands."""
    loop.go(LEFT)
    loop.world({"thing": thing})
    return bool(np.allclose(loop.go(ACROSS), ACROSS))


def hand_on_the_way(folder: Path) -> Vector3:
    """Where the fingers are in the middle of the way across [m]."""
    placed = robot_arm(make_robot(folder)).link_pose("hand", (LEFT + ACROSS) / 2)
    return Vector3(*map(float, placed[:3, 3] + 0.05 * placed[:3, 2]))


LOW, HIGH = (-0.5, -0.5, -0.1), (0.5, 0.5, 0.5)


def test_by_default_the_hand_may_touch_what_is_movable_and_nothing_else_may(tmp_path) -> None:
    cube = WorldObject(Box((0.02, 0.02, 0.02)), Pose(hand_on_the_way(tmp_path)))
    assert not reached(Loop(tmp_path, LEFT), cube)
    assert reached(Loop(tmp_path, LEFT), attrs.evolve(cube, movable=True))
    assert not reached(Loop(tmp_path, LEFT, free={}), attrs.evolve(cube, movable=True))
    arm_in_the_way = attrs.evolve(WALL["wall"], movable=True)
    assert not reached(Loop(tmp_path, LEFT), arm_in_the_way)


def test_by_default_the_hand_presses_on_the_floor_of_the_description(tmp_path) -> None:
    down = np.array([0.0, 1.4, 1.2, 0.5, 0.0, 0.0])
    lowest = {}
    for name, may_touch in (("hand", None), ("nothing", dict[str, tuple[str, ...]]())):
        loop = Loop(tmp_path, described={"floor": 0.0}, may_touch=may_touch)
        lowest[name] = Seen({}, floor=True).distance(loop.go(down))
    assert -0.011 < lowest["hand"] < -0.008
    assert lowest["nothing"] > 0.002


@pytest.mark.parametrize(
    ("region", "touches"),
    [
        ({"lower": LOW, "upper": HIGH}, True),
        ({"lower": LOW, "upper": HIGH, "links": ("hand", "finger")}, True),
        ({"lower": LOW, "upper": HIGH, "links": ("hand",)}, False),
        ({"lower": LOW, "upper": (0.5, 0.5, 0.1)}, False),  # the object reaches beyond it
    ],
)
@pytest.mark.parametrize("kind", ["box", "mesh", "voxels"])
def test_what_lies_in_a_region_may_be_touched(tmp_path, kind: str, region: dict[str, Any], touches: bool) -> None:
    place = hand_on_the_way(tmp_path)
    cells = np.array(list(itertools.product((-1, 0), repeat=3)))
    corners = np.array(list(itertools.product((-0.01, 0.01), repeat=3)))
    shape: Any = {
        "box": Box((0.02, 0.02, 0.02)),
        "mesh": Mesh(corners, np.array([[0, 1, 2], [5, 6, 7], [0, 5, 6]]), convex=True),
        "voxels": Voxels(0.01, cells),
    }[kind]
    if not touches and "links" not in region:
        region = {**region, "upper": (0.5, 0.5, place.z)}
    loop = Loop(tmp_path, LEFT, regions={"tray": RegionOptions(**region)})
    assert reached(loop, WorldObject(shape, Pose(place))) == touches


def test_an_object_that_leaves_a_region_may_be_touched_no_more(tmp_path) -> None:
    place = hand_on_the_way(tmp_path)
    cube = WorldObject(Box((0.02, 0.02, 0.02)), Pose(place))
    upper = (0.5, 0.5, place.z + 0.011)
    loop = Loop(tmp_path, LEFT, regions={"tray": RegionOptions(LOW, upper)})
    assert reached(loop, cube)
    higher = attrs.evolve(cube, pose=Pose(attrs.evolve(place, z=place.z + 0.004)))
    assert not reached(loop, higher)
    assert reached(loop, cube)


def test_a_region_names_links_and_no_sites(tmp_path) -> None:
    region = RegionOptions((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), ("hand", "tip"))
    (fault,) = ClearanceGuardOptions(regions={"tray": region}).check(make_robot(tmp_path), ())
    assert "unknown link 'tip'" in str(fault)
    assert "base, turret, upper, lower, wrist, hand, finger" in str(fault)


ODD_NAMES = ("cloud in tray", "cloud", "floor", "floor of the world")
CELLS = np.array([[15, 0, 5], [18, 0, 5], [30, 0, 5]])


@pytest.mark.parametrize("others", list(itertools.permutations(ODD_NAMES)))
def test_no_object_takes_the_place_of_another_one(tmp_path, others: tuple[str, ...]) -> None:
    """Whatever names they have: also those that the guard gives to the parts of a cloud, and beside the table."""
    loop = Loop(tmp_path, floor=0.0, regions={"tray": RegionOptions((0.14, -0.1, 0.0), (0.2, 0.1, 0.3))})
    things = {name: box(1, 1, 1, 0.1, 0.1, 0.1 + number / 10) for number, name in enumerate(others)}
    things["cloud"] = WorldObject(Voxels(0.01, CELLS))
    known = loop.guard._permissions.applied(World(things)).objects.values()
    assert sorted(thing.shape.size[2] for thing in known if isinstance(thing.shape, Box)) == sorted(
        thing.shape.size[2] for thing in things.values() if isinstance(thing.shape, Box)
    )
    assert sum(isinstance(thing.shape, Plane) for thing in known) == 1
    cells = [thing.shape.cells.tolist() for thing in known if isinstance(thing.shape, Voxels)]
    assert sorted(itertools.chain(*cells)) == CELLS.tolist()


@pytest.mark.parametrize("names", list(itertools.permutations(("a", "b", "a and b"))))
def test_cells_of_one_region_do_not_take_the_place_of_those_of_two(tmp_path, names: tuple[str, ...]) -> None:
    left, right = ((0.14, -0.1, 0.0), (0.17, 0.1, 0.3)), ((0.17, -0.1, 0.0), (0.2, 0.1, 0.3))
    regions = {name: RegionOptions(*(right if name == "a and b" else left)) for name in names}
    loop = Loop(tmp_path, regions=regions)
    known = loop.guard._permissions.applied(World({"cloud": WorldObject(Voxels(0.01, CELLS))})).objects.values()
    cells = [thing.shape.cells.tolist() for thing in known if isinstance(thing.shape, Voxels)]
    assert sorted(cells) == sorted([each] for each in CELLS.tolist())


def test_clouds_do_not_take_the_place_of_parts_of_others(tmp_path) -> None:
    everywhere = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    loop = Loop(
        tmp_path, regions={"tray": RegionOptions(*everywhere), "x in tray": RegionOptions((-1, -1, -1), (0, 0, 0))}
    )
    clouds = {"cloud": [[-15, -5, -5]], "cloud in x": [[15, 0, 5]]}
    things = {name: WorldObject(Voxels(0.01, np.array(cells))) for name, cells in clouds.items()}
    known = loop.guard._permissions.applied(World(things)).objects.values()
    cells = [thing.shape.cells.tolist() for thing in known if isinstance(thing.shape, Voxels)]
    assert sorted(cells) == sorted(clouds.values())


def test_cells_in_several_regions_may_be_touched_by_the_links_of_each(tmp_path) -> None:
    inner, outer = ((0.14, -0.1, 0.0), (0.17, 0.1, 0.3)), ((0.1, -0.2, 0.0), (0.2, 0.2, 0.4))
    regions = {"inner": RegionOptions(*inner, ("hand",)), "outer": RegionOptions(*outer, ("wrist",))}
    loop = Loop(tmp_path, regions=regions)
    known = loop.guard._permissions.applied(World({"cloud": WorldObject(Voxels(0.01, CELLS))})).objects
    divided = {
        name: (thing.may_touch, thing.shape.cells.tolist())
        for name, thing in known.items()
        if isinstance(thing.shape, Voxels)
    }
    assert divided == {
        "cloud": (frozenset(), [[30, 0, 5]]),
        "cloud in outer": (frozenset({"wrist"}), [[18, 0, 5]]),
        "cloud in inner and outer": (frozenset({"hand", "wrist"}), [[15, 0, 5]]),
    }


@pytest.mark.parametrize("key", ["margin", "self_margin"])
def test_a_margin_is_more_than_what_a_pair_may_lose_between_two_looks(key: str) -> None:
    wrong: dict[str, Any] = {key: 0.0009}
    with pytest.raises(ValueError, match=r"0\.0009 is too small"):
        ClearanceGuardOptions(**wrong)


def test_cells_of_a_cloud_beyond_a_region_still_count(tmp_path) -> None:
    """The hand sweeps through the cells in the region; those of the wall stay an obstacle."""
    place = hand_on_the_way(tmp_path)
    inside = np.floor(np.array([[place.x, place.y, place.z]]) / 0.02).astype(np.int64)
    wall = np.array([[x, 2, z] for x in range(3, 12) for z in range(4, 16)])
    tray = RegionOptions(tuple(0.02 * inside[0]), tuple(0.02 * (inside[0] + 1)))
    loop = Loop(tmp_path, LEFT, regions={"tray": tray})
    assert reached(loop, WorldObject(Voxels(0.02, inside)))
    assert not reached(loop, WorldObject(Voxels(0.02, np.concatenate([inside, wall]))))


@pytest.mark.parametrize(
    ("lower", "upper", "fault"),
    [
        ((0, 0, 0), (1, 0, 1), "must be below"),
        ((0, 0, math.nan), (1, 1, 1), "numbers from"),
        ((0, 0, 0), (1, 1, 1e9), "numbers from"),
    ],
)
def test_regions_that_are_none_are_refused(lower, upper, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        RegionOptions(lower, upper)


def test_a_carried_object_is_part_of_the_arm(tmp_path) -> None:
    stick = WorldObject(Box((0.02, 0.2, 0.02)), Pose(Vector3(0.0, 0.0, 0.08)), "hand", ("hand", "finger"))
    at = {}
    for name, carried in (("none", {}), ("stick", {"stick": stick})):
        loop = Loop(tmp_path, LEFT)
        loop.world(WALL | carried)
        at[name] = loop.go(np.array([1.0, 1.2, 0.6, -1.5, 0.0, 0.0]), 50) * 0 + loop.go(ACROSS)
    assert at["stick"][0] > at["none"][0]


def test_a_stale_world_holds_or_not_as_stated(tmp_path) -> None:
    for rule in ("hold", "keep"):
        loop = Loop(tmp_path, when_stale=rule)
        wanted = np.array([1.0, 0.3, 0.0, 0.0, 0.0, 0.0])
        loop.go(wanted, 10)
        loop.world({}, stale="cloud 'top' is 2.0 s old")
        at = loop.go(wanted, 100)
        assert (np.abs(at - wanted).max() < 1e-6) == (rule == "keep")
        loop.world({})
        assert loop.go(wanted) == pytest.approx(wanted)


def test_joints_that_stray_from_their_path_widen_the_margin(tmp_path) -> None:
    """A lag behind the path does not; a constant offset of the measured position does."""
    at = {}
    for name, offset in (("none", 0.0), ("offset", 0.05)):
        loop = Loop(tmp_path, LEFT)
        loop.world(WALL)
        for _ in range(120):
            loop.tick(ACROSS, loop.position - np.array([offset, 0, 0, 0, 0, 0]))
        at[name] = loop.position[0]
        said = json.loads(loop.guard.overruled)["text"]
        assert ("pan was 0.05 rad from its commands" in said) == (offset > 0)
    assert at["offset"] > at["none"] + 0.02


@pytest.mark.parametrize("rate_hz", [20, 50, 100, 500])
def test_joints_that_lag_are_on_their_path_between_two_commands_too(tmp_path, rate_hz: int) -> None:
    """At 20 Hz and 3 rad/s, two commands are 0.15 rad apart: a servo in between has not strayed."""
    loop = Loop(tmp_path, period_ns=ns(1 / rate_hz))
    wanted, before = np.array([1.5, 0.6, 0.0, 0.0, 0.0, 0.0]), loop.position
    strays, fastest = [], 0.0
    for share in np.random.default_rng(rate_hz).random(rate_hz // 2).tolist():
        at = loop.position
        loop.tick(wanted, before + share * (at - before))
        fastest, before = max(fastest, float(np.abs(at - before).max()) * rate_hz), at
        strays.append(loop.guard.strays)
    assert fastest == pytest.approx(loop.robot.max_velocity[0], rel=0.01)
    assert np.max(strays) < 1e-9


def test_the_way_between_the_newest_command_and_the_oldest_is_none_of_the_path(tmp_path) -> None:
    """An arm that has turned by 1.5 rad on a bow is not on its path where the bow's ends are joined."""
    loop = Loop(tmp_path)
    for turn in np.linspace(0, np.pi, 45).tolist():
        loop.tick(np.array([0.5 - 0.5 * math.cos(turn), 0.5 * math.sin(turn), 0.0, 0.0, 0.0, 0.0]))
    here = loop.position
    loop.tick(here, here / 2)
    assert loop.guard.strays.max() > 0.1


def test_a_joint_that_strays_widens_no_margin_of_what_it_does_not_lead_nearer(tmp_path) -> None:
    """The pan turns about the vertical: however far off it is, the hand comes as near to the table."""
    down = np.array([0.0, 1.4, 1.2, 0.5, 0.0, 0.0])
    lowest = []
    for offset in (0.0, 0.1):
        loop = Loop(tmp_path, floor=0.0, may_touch={})
        for _ in range(200):
            loop.tick(down, loop.position - np.array([offset, 0, 0, 0, 0, 0]))
        lowest.append(Seen({}, floor=True).distance(loop.position))
    assert lowest[1] < lowest[0] + 0.005


def make_change(kind: str) -> WorldObject:
    shape: Any = {
        "box": Box((0.1, 0.2, 0.3)),
        "sphere": Sphere(0.1),
        "plane": Plane(),
        "mesh": Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]), np.array([[0, 1, 2]])),
        "boxes": Boxes(np.full((2, 3), 0.1), np.tile(np.concatenate([np.zeros((1, 3)), np.eye(3)]), (2, 1, 1))),
        "voxels": Voxels(0.02, np.array([[0, 0, 0], [4, -3, 2]])),
        "far voxels": Voxels(0.02, np.array([[0, 0, 0], [40_000, -3, 2]])),
    }[kind]
    return WorldObject(shape, Pose(Vector3(0.1, 0.2, 0.3)), None, ("a", "b"))


@pytest.mark.parametrize("kind", ["box", "sphere", "plane", "mesh", "boxes", "voxels", "far voxels"])
def test_a_change_of_the_world_survives_the_way_to_control(kind: str) -> None:
    thing = make_change(kind)
    sent = WorldChange({"it": thing}, ("gone",), "too old", {"other": thing.pose})
    read = WorldChange.read(json.loads(json.dumps(sent.message())))
    assert (read.removed, read.stale, read.moved) == (sent.removed, sent.stale, sent.moved)
    assert json.dumps(read.message()) == json.dumps(sent.message())


def written(shape: Any, at: float = 0.0, turn: tuple[int, ...] = (0, 0, 0, 1)) -> dict[str, Any]:
    return {"changed": {"it": {"shape": shape, "pose": [at, 0, 0, *turn], "link": None, "may_touch": []}}}


WRONG: list[Any] = [
    {"changed": {"it": None}},
    {"changed": []},
    {"removed": 3},
    written(["box", [0.1, 0.1, 0.1]], turn=()),
    written(["box", [0.1, 0.1, 0.1]], turn=(0, 0, 0, 0)),
    written(["box", [float("nan"), 1, 1]]),
    written(["box", [1, 1, 1]], float("inf")),
    written(["ball", 1]),
    written(["voxels", 0.1, "!!", "<i8"]),
    written(["voxels", 0.1, "AAAA", "<f8"]),
    written(["sphere", -1.0]),
    written(["mesh", "", "", False]),
    written(["boxes", "", ""]),
    written(["boxes", "AAAA", "AAAA"]),
    {"moved": {"wall": [0, 0, 0]}},
    {"moved": {"wall": [0, 0, math.nan, 0, 0, 0, 1]}},
    {"moved": {"wall": [0, 0, 1e4, 0, 0, 0, 1]}},
    {"moved": {"wall": [0, 0, 0, 0, 0, 0, 0]}},
    {"moved": ["wall"]},
]


def test_malformed_changes_are_refused_and_change_nothing(tmp_path) -> None:
    loop = Loop(tmp_path, LEFT)
    loop.world(WALL)
    for message in WRONG:
        with pytest.raises(HardwareError, match="change of the world"):
            loop.guard.world(message)
    assert 0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3, "the arm moves up to the wall, and not through it"


@pytest.mark.parametrize(("name", "link"), [("hand", None), ("stick", "nowhere")])
def test_an_object_that_cannot_be_checked_holds_the_arm_until_it_is_gone(tmp_path, caplog, name: str, link) -> None:
    """One with the name of a link, or on a link that is not there: the arm must not move as if it were not there."""
    loop = Loop(tmp_path, LEFT)
    loop.world({**WALL, name: attrs.evolve(box(0, 0, 1, 0.1, 0.1, 0.1), link=link)})
    loop.world({"post": POSTS["post"]})
    assert loop.go(ACROSS) == pytest.approx(LEFT)
    assert f"the guard cannot check object '{name}': " in json.loads(loop.guard.overruled)["text"]
    assert f"the guard cannot check object '{name}': " in caplog.text
    assert loop.guard.counts["refused_objects"] == 1
    loop.world({}, name)
    assert 0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3, "and those beside it are known"


def test_keep_goes_on_without_an_object_that_cannot_be_checked(tmp_path) -> None:
    loop = Loop(tmp_path, LEFT, when_stale="keep")
    loop.world({**WALL, "stick": attrs.evolve(WALL["wall"], link="nowhere")})
    assert 0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3


def test_an_object_that_can_be_checked_replaces_one_that_cannot(tmp_path) -> None:
    loop = Loop(tmp_path, LEFT)
    loop.world({"wall": attrs.evolve(WALL["wall"], link="nowhere")})
    assert loop.go(ACROSS) == pytest.approx(LEFT)
    loop.world(WALL)
    assert 0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3


class Gate:
    """Lets the guard build a world once it is open."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.opened = threading.Event()
        self.worlds: list[World] = []
        make = ClearanceGuard._made

        def made(guard: ClearanceGuard, world: World, before: Pairs | None) -> Any:
            if threading.current_thread() is not threading.main_thread():
                assert self.opened.wait(60)
                self.worlds.append(world)
            return make(guard, world, before)

        monkeypatch.setattr(ClearanceGuard, "_made", made)


class TestBuildingBesideTheLoop:
    """In real time, a thread makes the pairs; the loop does not wait, and takes over what is finished."""

    @pytest.fixture
    def gate(self, monkeypatch) -> Gate:
        return Gate(monkeypatch)

    def settle(self, loop: Loop, gate: Gate) -> None:
        """Wait until everything reported so far is finished."""
        thread = loop.guard._building._thread
        assert thread is not None
        gate.opened.set()
        thread.join()

    def test_the_loop_goes_on_and_then_has_the_new_world(self, tmp_path, gate) -> None:
        loop = Loop(tmp_path, LEFT, clock=RealClock())
        loop.world(WALL)
        assert loop.go(ACROSS) == pytest.approx(ACROSS), "the wall is not built yet, and nobody waits for it"
        loop.go(LEFT)
        self.settle(loop, gate)
        assert loop.go(ACROSS)[0] > 0

    def test_the_loop_takes_over_what_the_thread_made_as_it_is_and_without_a_lock(self, tmp_path, gate) -> None:
        """Objects, shapes and pairs are made in the thread; the loop changes a reference to them."""
        loop = Loop(tmp_path, LEFT, clock=RealClock())
        building, before = loop.guard._building, loop.guard._pairs
        loop.world(WALL)
        self.settle(loop, gate)
        made = building.finished[0].pairs
        building._lock = None  # type: ignore[assignment]  # whoever takes it fails
        loop.tick(LEFT)
        assert loop.guard._pairs is made
        assert list(building.old) == [before], "and leaves it to the thread to free them"
        assert not loop.safety.guard_fault

    def test_a_flood_of_changes_makes_one_world(self, tmp_path, gate) -> None:
        loop = Loop(tmp_path, LEFT, clock=RealClock())
        for number in range(300):
            loop.world({f"object{number % 40}": box(1, 1, 1 + number / 100, 0.1, 0.1, 0.1)})
        loop.world(WALL)
        self.settle(loop, gate)
        assert len(gate.worlds) <= 3
        assert loop.go(ACROSS)[0] > 0
        assert loop.guard.counts["world_changes"] == 301

    def test_a_cloud_is_built_in_steps_between_which_the_loop_may_run(self, tmp_path, monkeypatch) -> None:
        loop, steps = Loop(tmp_path), list[bool]()
        monkeypatch.setattr(ClearanceGuard, "_give_way", lambda guard: steps.append(guard._is_checking))
        cells = np.array(list(itertools.product(range(20), range(20), range(3))))
        loop.world({"cloud": WorldObject(Voxels(0.02, cells))})
        assert len(steps) > 6

    def test_worlds_do_not_pile_up_while_the_loop_takes_none(self, tmp_path) -> None:
        """Nor are motions of objects lost among them."""
        loop = Loop(tmp_path, LEFT)
        loop.world(WALL)
        for number in range(200):
            loop.world({f"object{number % 5}": box(1, 1, 1 + number / 100, 0.1, 0.1, 0.1)}, f"object{(number + 1) % 5}")
            loop.world({"wall": box(0.35, -0.6 + number * 0.6 / 199, 0.15, 0.4, 0.02, 0.3)})
        assert len(loop.guard._building.finished) <= 33
        assert 0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3

    def test_worlds_that_another_one_replaces_just_now_are_not_waited_for(self, tmp_path) -> None:
        class Emptied(deque[Any]):
            """As the loop may find it when the thread clears it between two steps of the loop."""

            def __bool__(self) -> bool:
                return True

        loop = Loop(tmp_path, LEFT)
        loop.guard._building.finished = Emptied()
        assert loop.go(ACROSS) == pytest.approx(ACROSS)
        assert not loop.safety.guard_fault

    def test_a_world_that_cannot_be_built_is_one_that_is_not_known(self, tmp_path, monkeypatch, caplog) -> None:
        loop = Loop(tmp_path, LEFT)
        make = loop.guard._building._make
        failing = True

        def made(world: World, before: Pairs | None) -> Any:
            if failing:
                raise MemoryError("no room")
            return make(world, before)

        monkeypatch.setattr(loop.guard._building, "_make", made)
        loop.world(WALL)
        assert loop.go(ACROSS)[0] == pytest.approx(LEFT[0])
        assert json.loads(loop.guard.overruled)["second"] == "the guard cannot take it in: MemoryError: no room"
        failing = False
        loop.world({})
        assert 0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3, "it was not lost"


def nonsense() -> Iterator[Any]:
    """Values that somebody may send in place of the right ones."""
    yield from (
        None,
        True,
        -1,
        0,
        10**400,
        1e308,
        math.nan,
        math.inf,
        "",
        "x",
        "\x00",
        [],
        [[]],
        {},
        {"a": 1},
        b"x",
        [None] * 8,
    )


def spoiled() -> Iterator[tuple[str, Any]]:
    """A right message with one value, at each place in it, replaced, left out, or doubled."""
    cloud = ["voxels", 0.1, "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA", "<i8"]
    things = {
        name: {"shape": shape, "pose": [1, 1, 1, 0, 0, 0, 1], "link": None, "may_touch": links}
        for name, shape, links in (("it", ["box", [0.1, 0.1, 0.1]], ["hand"]), ("cloud", cloud, []))
    }
    boxes = WorldChange({"boxes": make_change("boxes")}).message()["changed"]
    moved = {"boxes": [1, 1, 1, 0, 0, 0, 1]}
    right = {"changed": {**things, **boxes}, "removed": ["gone"], "stale": "", "moved": moved}

    def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        yield path
        inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, each in inner:
            yield from places(each, (*path, key))

    for path in places(right):
        for number, wrong in enumerate([*nonsense(), KeyError]):
            message = copy.deepcopy(right)
            if not path:
                yield f"all {number}", wrong if wrong is not KeyError else {}
                continue
            holder: Any = message
            for key in path[:-1]:
                holder = holder[key]
            if wrong is KeyError:
                del holder[path[-1]]
            else:
                holder[path[-1]] = wrong
            yield f"{'.'.join(map(str, path))} {number}", message


def test_messages_of_every_kind_neither_break_the_loop_nor_lose_the_wall(tmp_path) -> None:
    """Each is refused with a reason, or taken; the wall stands before and after, also while the arm moves at it."""
    loop = Loop(tmp_path, LEFT)
    loop.world(WALL)
    seen, refused, tried, nearest = Seen(WALL), 0, 0, 1.0
    for _, message in spoiled():
        tried += 1
        try:
            loop.guard.world(message)
        except HardwareError:
            refused += 1
        before = loop.position
        nearest = min(nearest, seen.along(before, loop.tick(ACROSS)))
        assert np.isfinite(loop.position).all()
        loop.guard.world({"changed": {}, "removed": ["it", "cloud", "boxes"], "stale": ""})
    assert (tried, refused > 400) == (1188, True)
    assert nearest > MARGIN_M - 0.001
    assert loop.go(ACROSS)[0] > 0


@pytest.mark.parametrize("at", few(range(0, 60, 4), 4))
@pytest.mark.parametrize("deleted", [("wall",), ("post", "wall"), ("post", "wall", "nothing")])
def test_a_world_that_is_deleted_in_motion_and_comes_back(tmp_path, at: int, deleted: tuple[str, ...]) -> None:
    """While it is gone the way is free; what comes back is avoided from where braking leads."""
    loop, seen = Loop(tmp_path, LEFT), Seen(WALL)
    loop.world(WALL | {"post": POSTS["post"]})
    loop.go(ACROSS, at)
    loop.world({}, *deleted)
    loop.go(ACROSS, 8)
    room = seen.along(loop.position, loop.safety.rest, 20)
    loop.world(WALL)
    nearest, before = 1.0, loop.position
    for _ in range(60):
        nearest, before = min(nearest, seen.along(before, loop.tick(ACROSS))), loop.position
    assert nearest > min(room, MARGIN_M) - 0.001


def flickering(kind: str, rng: np.random.Generator, number: int) -> WorldObject:
    """A wall, of which every other time a layer in front is seen in part, or that is measured to be thicker."""
    if kind == "box":
        return attrs.evolve(WALL["wall"], shape=Box((0.4, 0.02 + 0.002 * (number % 2), 0.3)))
    wall = np.array(list(itertools.product(range(15, 45), (-1, 0), range(30))))
    front = np.array(list(itertools.product(range(15, 45), (1,), range(30))))
    seen = rng.random(len(front)) < 0.3 * (number % 2)
    return WorldObject(Voxels(0.01, np.concatenate([wall, front[seen]])))


@pytest.mark.parametrize("kind", ["cloud", "box"])
def test_what_is_seen_differently_each_time_is_not_come_nearer_to(tmp_path, kind: str) -> None:
    loop, rng, nearest = Loop(tmp_path, LEFT), np.random.default_rng(0), []
    seen = Seen({"wall": box(0.3, 0.0, 0.15, 0.3, 0.02, 0.3)})
    for number in range(44):
        loop.world({"wall": flickering(kind, rng, number)})
        loop.go(ACROSS, 5)
        nearest.append(seen.distance(loop.position))
    assert nearest[-1] > min(nearest[12:20]) - 0.0001
    assert nearest[-1] > 0.0025


def test_an_object_that_comes_into_the_way_is_braked_for(tmp_path) -> None:
    """It was far: what was known of its distance does not count any more."""
    loop = Loop(tmp_path, LEFT)
    loop.world({"wall": box(0.35, -9.0, 0.15, 0.4, 0.02, 0.3)})
    loop.go(LEFT, 20)
    loop.world(WALL)
    assert 0.0 < loop.go(ACROSS)[0] < LEFT[0] - 0.3


def test_an_object_that_moves_is_where_it_is_and_not_where_it_was(tmp_path) -> None:
    loop = Loop(tmp_path, LEFT)
    loop.world(WALL)
    loop.go(ACROSS, 20)
    loop.world({"wall": box(0.35, -0.6, 0.15, 0.4, 0.02, 0.3)})
    assert loop.go(ACROSS) == pytest.approx(ACROSS)
    loop.world({}, "wall")
    assert loop.go(LEFT) == pytest.approx(LEFT)
    assert loop.guard.counts["ticks"] == 0 or loop.guard.overruled == ""


@pytest.mark.parametrize("trembles_m", [5e-4, 1e-7])
def test_an_object_that_trembles_is_not_come_nearer_to(tmp_path, trembles_m: float) -> None:
    """As one that a camera tracks: what is allowed for rounding is allowed once, not at every motion."""
    seen, clear, inside = Seen(WALL), LEFT, (LEFT + ACROSS) / 2
    for _ in range(30):
        at = (clear + inside) / 2
        clear, inside = (at, inside) if seen.distance(at) > 0.0015 else (clear, at)
    loop, rng = Loop(tmp_path, clear), np.random.default_rng(3)
    loop.world(WALL)
    wall = WALL["wall"].pose.position
    for _ in range(400):
        pose = Pose(Vector3(wall.x, wall.y + rng.uniform(-trembles_m, trembles_m), wall.z))
        loop.guard.world(WorldChange({}, moved={"wall": pose}).message())
        loop.tick(ACROSS)
    assert seen.distance(loop.position) > 0.001


def test_an_object_that_is_named_like_the_table_does_not_take_its_place(tmp_path) -> None:
    loop = Loop(tmp_path, np.array([0.0, 0.3, 0.3, 0.2, 0.0, 0.3]), floor=0.0, may_touch={"floor": ("base", "turret")})
    loop.world({"floor": box(0.9, 0.9, 0.9, 0.01, 0.01, 0.01)})
    down_to = loop.go(np.array([0.0, 1.8, 1.2, 0.6, 0.0, 0.0]))
    assert Seen({}, floor=True).distance(down_to) > MARGIN_M - 0.001
    loop.world(dict(POSTS, floor=WALL["wall"]))
    loop.go(LEFT)
    assert Seen(WALL).distance(loop.go(ACROSS)) > MARGIN_M - 0.001, "and counts"


def test_from_a_crowd_a_slow_motion_leads_out(tmp_path) -> None:
    """However many things are near: some that come no nearer are known to do so by where the motion ends."""
    start, up = np.array([0.0, 0.9, 0.6, 0.3, 0.0, 0.2]), np.array([0.0, 0.0, 0.6, 0.3, 0.0, 0.2])
    loop, rng = Loop(tmp_path, start), np.random.default_rng(1)
    arm = loop.guard._arm
    data = arm.model.createData()
    pinocchio.forwardKinematics(arm.model, data, arm.native(start))
    lower = next(shape for shape in arm.shapes if shape.link == "lower")
    placed = data.oMi[lower.joint].homogeneous @ lower.placement
    along, across = placed[:3, 2], np.array([0.0, 1.0, 0.0])
    below = -np.abs(np.cross(along, across)) * (-np.sign(along[2]), 1.0, 1.0)
    crowd = {}
    for number in range(150):
        place = placed[:3, 3] + rng.uniform(-0.05, 0.05) * along + rng.uniform(-0.01, 0.01) * across + 0.013 * below
        crowd[f"bead {number}"] = box(*place, 0.004, 0.004, 0.004)
    loop.world(crowd)
    for number in range(701):
        loop.tick(start + (number / 700) ** 2 * (up - start))
    assert np.abs(loop.go(up, 60) - up).max() < 0.01
    assert loop.guard.counts["pairs"] > 600


class TestFeed:
    """What tells the guard of the world: each change once, and in its words."""

    def make(self, observed: list[ObservedWorld]) -> tuple[GuardFeed, list[WorldChange]]:
        bus, sent = Bus(SteppedClock(7)), []
        bus.serve(OBSERVED, lambda _: observed[-1])
        session = SimpleNamespace(bus=bus, change_world=lambda change: sent.append(WorldChange.read(change)))
        feed = GuardFeed(session)
        return feed, sent

    def test_each_change_is_sent_once(self) -> None:
        worlds = [ObservedWorld(World(WALL))]
        feed, sent = self.make(worlds)
        steps = [
            (World(WALL), ""), (World(WALL), ""), (World(WALL | POSTS), ""), (World(POSTS), "too old"),
            (World({"wall": POSTS["wall"]}), ""),
        ]  # fmt: skip
        known = World()
        for world, stale in steps:
            before = len(sent)
            worlds.append(ObservedWorld(world, refusal=stale))
            feed._update()
            assert len(sent) <= before + 1
            if len(sent) > before:
                known = sent[-1].apply(known)
                assert sent[-1].stale == stale
            assert known.objects == world.objects
        assert len(sent) == len(steps) - 1

    def test_a_world_that_is_still_awaited_is_not_known(self) -> None:
        """Until the first message of a cloud, the arm must not move as if nothing were there."""
        worlds = [ObservedWorld(World(WALL), refusal="nothing has come", is_awaited=True)]
        feed, sent = self.make(worlds)
        feed._update()
        worlds.append(ObservedWorld(World(WALL)))
        feed._update()
        assert [each.stale for each in sent] == ["nothing has come", ""]
