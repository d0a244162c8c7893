"""The table of messages to the world in `docs/explanation/safety.md`: each row is tried, while a policy moves.

The page is the source: what a row says of its messages is what comes of each of them. Whatever is sent, the guard keeps
the arm off the wall that has been there since the start.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import entrances
import numpy as np
import pytest
from entrance_table import PAGE
from entrances import FAR, WALL
from ibrobot_eval.episodes import interventions
from ibrobot_planning.world.checked_arm import may_touch_arm
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import Voxels, World, WorldObject, observed_world
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import Header, PointCloud2, PointField
from ibrobot_core.control.commands import ChangeWorld, GetCounters
from ibrobot_core.errors import IbrobotError

pytestmark = pytest.mark.integration

HEADING = "### What messages do to the world"
WRONG: tuple[Any, ...] = (
    float("nan"),
    float("inf"),
    -float("inf"),
    1e308,
    -1e308,
    1e4,
    "x",
    None,
    [],
    {},
    [1.0, 2.0, 3.0, 4.0],
)
"""In place of a number or of three."""
_LINK = "gripper"
_FARTHEST_RAD = FAR - 0.01
type Message = Callable[[], object]


def read_rows() -> dict[str, str]:
    """What the page says of the messages: the name of a row, in backquotes, and its answer."""
    section = PAGE.read_text(encoding="utf-8").partition(f"{HEADING}\n")[2].partition("\n#")[0]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return {re.findall("`(.+?)`", first)[0]: answer for first, answer, *_ in lines[2:]}


class Told:
    """A run whose policy moves at a wall, and messages to the world meanwhile."""

    overrides: tuple[str, ...] = ()

    def __init__(self, folder: Path) -> None:
        self.folder, self.entrance = folder, entrances.Policy()
        self.run = self.entrance.launch(WALL, f"world.meshes={folder}", *self.overrides)
        self.call = self.run.session.bus.call
        self.begun = len(self.run.commands)
        guard = self.run.session.config.control.guard
        assert guard is not None
        arm = may_touch_arm(self.run.session.config.robot, self.run.session.log)
        world = observed_world(self.run.session.bus).world
        self._checks = Collisions(arm, world, arm.joint_names, padding=guard.options.margin - 0.001)

    def tick(self, count: int = 1) -> None:
        self.run.ticks(count, self.entrance.ask)

    def check_wall(self) -> None:
        """No command since the start has led nearer to the wall than the margin."""
        commands = np.array(self.run.commands)
        hit = self._checks.first_hit(commands)
        assert hit == len(commands), [str(each) for each in self._checks.contacts(commands[hit])]
        assert commands[:, self.entrance.column].max() < _FARTHEST_RAD

    def add(self, name: str = "it", **shape: Any) -> Message:
        thing = {"position": [0.7, 0.7, 0.7], **shape}
        return lambda: self.call("/world/add", {"name": name, "object": thing, "replace": True})

    def move(self, name: str = "it", **pose: Any) -> Message:
        return lambda: self.call("/world/move", {"name": name, "position": [0.7, 0.7, 0.7], **pose})

    def file(self, name: str, data: bytes) -> str:
        (self.folder / name).write_bytes(data)
        return name


SHAPES: Mapping[str, Mapping[str, Any]] = {
    "box": {"size": [0.1, 0.1, 0.1]},
    "sphere": {"radius": 0.1},
    "cylinder": {"radius": 0.1, "height": 0.1},
    "capsule": {"radius": 0.1, "height": 0.1},
}


def numbers(told: Told) -> Iterator[Message]:
    """One wrong value at each place of a number."""
    told.add(shape="sphere", radius=0.1)()
    for shape, sizes in SHAPES.items():
        right = {"shape": shape, "position": [0.7, 0.7, 0.7], "rpy": [0.0, 0.0, 0.0], **sizes}
        places = [key for key in right if key != "shape"]
        for key, wrong in itertools.product(places, WRONG):
            if isinstance(right[key], float):
                yield told.add(**{**right, key: wrong})
                continue
            yield told.add(**{**right, key: wrong}) if wrong != [] or key == "size" else told.add(**{**right, key: [1]})
            for number in range(3):
                several = list(right[key])
                several[number] = wrong
                yield told.add(**{**right, key: several})
    for wrong, number in itertools.product(WRONG, range(3)):
        place = [0.7, 0.7, 0.7]
        place[number] = wrong
        yield told.move(position=place)
    for stamp in (float("nan"), float("inf"), -1, 2**63, "now"):
        yield told.move(stamp_ns=stamp)


def sizes(told: Told) -> Iterator[Message]:
    for (shape, right), wrong in itertools.product(SHAPES.items(), (0, 0.0, -0.0, -0.1, 100.1, 1e30, -1e-320)):
        for key, value in right.items():
            if key != "size":
                yield told.add(shape=shape, **{**right, key: wrong})
                continue
            for number in range(3):
                several = list(value)
                several[number] = wrong
                yield told.add(shape=shape, **{**right, key: several})


def stl(triangles: np.ndarray) -> bytes:
    """A binary STL of triangles, shape (M, 3, 3)."""
    rows = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = triangles
    return bytes(80) + struct.pack("<I", len(triangles)) + rows.tobytes()


def bowl(count: int) -> np.ndarray:
    """So many triangles, of a half sphere with a radius of 0.1 m, open at its top."""
    rings = int(np.sqrt(count / 8))
    turns, tilts = np.linspace(0, 2 * np.pi, 4 * rings + 1), np.linspace(np.pi / 2, np.pi, rings + 1)
    turn, tilt = np.meshgrid(turns, tilts)
    at = 0.1 * np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]
    return np.stack([np.stack([a, b, c], axis=2), np.stack([b, d, c], axis=2)]).reshape(-1, 3, 3)


def meshes(told: Told) -> Iterator[Message]:
    """Files that are no meshes, or meshes that are no bodies."""
    flat = np.array([[[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0.1, 0.1, 0], [0.1, 0, 0], [0, 0.1, 0]]])
    wrong = {
        "nothing.stl": b"",
        "none.stl": stl(np.zeros((0, 3, 3))),
        "text.stl": b"solid nothing\nendsolid nothing\n",
        "other.stl": b"\x89PNG\r\n\x1a\n" * 30,
        "short.stl": stl(bowl(800))[:999],
        "count.stl": stl(flat)[:80] + struct.pack("<I", 2**31) + stl(flat)[84:],
        "point.stl": stl(np.zeros((9, 3, 3))),
        "line.stl": stl(np.tile(np.linspace(0, 1, 3)[:, None], (5, 1, 3))),
        "metres.stl": stl(1e4 * bowl(800)),
        "large.stl": stl(bowl(90_000)),
        "corner.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
        "empty.obj": b"# nothing\n",
        "header.ply": b"ply\nformat ascii 1.0\n",
    }
    for value in (float("nan"), float("inf"), -float("inf"), 3e38):
        spoiled = bowl(800)
        spoiled[7, 1, 2] = value
        wrong[f"{value}.stl"] = stl(spoiled)
    for name, data in wrong.items():
        yield told.add(shape="mesh", file=told.file(name, data))
    part = told.file("part.stl", stl(flat))
    yield told.add(shape="mesh", file=part, convex=True)  # flat, so it has no hull
    for scale in (0, -1, float("nan"), float("inf"), 1e6, 1e300):
        yield told.add(shape="mesh", file=part, scale=scale)
    for file in ("missing.stl", "../part.stl", "/etc/passwd", "", "part.step", "part.stl/part.stl", "\0.stl"):
        yield told.add(shape="mesh", file=file)


def large_meshes(told: Told) -> Iterator[Message]:
    """Beside the arm, some in motion, carried, or with a hull; together they have nearly all triangles allowed."""
    for number, count in enumerate((900, 1_100, 20_000, 79_000, 79_000)):
        file = told.file(f"bowl{number}.stl", stl(bowl(count)))
        yield told.add(f"bowl{number}", shape="mesh", file=file, position=[-0.3, 0.2, 0.1 * number])
        if number < 4:
            yield told.add("hull", shape="mesh", file=file, convex=True, position=[0.1, 0.7, 0.5])
            yield partial(told.call, "/world/remove", {"name": "hull"})
        yield told.move(f"bowl{number}", position=[-0.3, 0.25, 0.1 * number])
    yield partial(told.call, "/world/attach", {"name": "bowl1", "link": _LINK})
    yield partial(told.call, "/world/detach", {"name": "bowl1"})


def names(told: Told) -> Iterator[Message]:
    """Of objects and links that are not there, e.g. since they have another name now."""
    sphere: dict[str, Any] = {"shape": "sphere", "radius": 0.1}
    told.add(**sphere)()
    for name in ("", "x" * 101, _LINK, "base", "world"):
        yield told.add(name, **sphere)
    for name in ("gripper_old", "Gripper", "gripper ", "", "wall"):
        yield told.add(link=name, **sphere)
        yield told.add(may_touch=[name, "nobody"], **sphere)
        yield partial(told.call, "/world/attach", {"name": "it", "link": name})
        yield partial(told.call, "/world/allow", {"name": "it", "may_touch": [name, "nobody"]})
    for name in ("itt", "It", "", "it ", _LINK, "floor"):
        yield told.move(name)
        if name != "floor":  # that of planners, which what the hand carries may touch
            yield partial(told.call, "/world/touch", {"objects": [name]})
        for service in ("remove", "detach", "attach"):
            yield partial(told.call, f"/world/{service}", {"name": name})
    requests: tuple[Any, ...] = (None, [], "nobody", {}, {"name": None}, {"name": ["it"]}, {"nam": "it"})
    for request in requests:
        for service in ("add", "remove", "move", "attach", "detach", "touch", "allow"):
            if not (service == "touch" and not request):  # nothing may be touched any more
                yield partial(told.call, f"/world/{service}", request)


def floods(told: Told) -> Iterator[Message]:
    """As many objects as there may be, between two ticks, and 200 motions in each of the next ones."""

    def fill() -> None:
        for number in range(199):
            told.add(f"box{number}", shape="box", size=[0.02] * 3, position=[-0.2, 0.02 * number - 2, 0.3])()

    def shake(by: float) -> None:
        for number in range(199):
            told.move(f"box{number}", position=[-0.2, 0.02 * number - 2, 0.3 + by])()

    yield fill
    for by in (0.01, 0.02, 0.03):
        yield partial(shake, by)


def more(told: Told) -> Iterator[Message]:
    """Objects beyond the 200."""
    for number in range(199):
        told.add(f"box{number}", shape="box", size=[0.02] * 3, position=[-0.2, 0.02 * number - 2, 0.3])()
    for number in range(100):
        yield told.add(f"more{number}", shape="sphere", radius=0.01)


def deleted(told: Told) -> Iterator[Message]:
    """The whole world, in motion, and back before the arm can be where it was."""
    box = {"shape": "box", "size": [0.06, 0.06, 0.08], "position": [0.1, -0.16, 0.06]}
    for _ in range(5):
        yield partial(told.call, "/world/remove", {"name": "wall"})
        yield told.add("wall", **box)
        yield told.add("wall", **{**box, "shape": "sphere", "radius": 0.04, "size": None})
        yield told.add("wall", **box)


def others(told: Told) -> Iterator[Message]:
    """What no run sends to control: one wrong value at each place of the shape and the poses of a right message."""
    control, pose = told.run.session.control, [0.7, 0.7, 0.7, 0.0, 0.0, 0.0, 1.0]
    thing = {"shape": ["box", [0.1, 0.1, 0.1]], "pose": pose, "link": None, "may_touch": [], "movable": False}

    def change(**values: Any) -> dict[str, Any]:
        return {"changed": {"it": {**thing, **values}}, "removed": ["wall"], "stale": "", "moved": {}}

    for wrong in WRONG:
        messages = [change(pose=[*pose[:k], wrong, *pose[k + 1 :]]) for k in range(7)]
        messages += [change(shape=["box", [*[0.1] * k, wrong, *[0.1] * (2 - k)]]) for k in range(3)]
        messages += [
            change(shape=[wrong, 0.1]),
            change(shape=["sphere", wrong]),
            change(shape=wrong),
            change(pose=wrong),
        ]
        messages += [{**change(), "moved": {"wall": [*pose[:k], wrong, *pose[k + 1 :]]}} for k in range(7)]
        messages += [{**change(), "moved": {"wall": wrong}}]
        for each in messages:
            yield partial(control.call, ChangeWorld(each))


ROWS: Mapping[str, Callable[[Told], Iterator[Message]]] = {
    "numbers": numbers, "sizes": sizes, "meshes": meshes, "large meshes": large_meshes, "names": names,
    "floods": floods, "more": more, "deleted": deleted, "others": others,
}  # fmt: skip
LEAST = {
    "numbers": 300, "sizes": 40, "meshes": 30, "large meshes": 20, "names": 100, "floods": 4, "more": 100,
    "deleted": 20, "others": 200,
}  # fmt: skip
"""Messages of each row, at least."""


@pytest.fixture(scope="module")
def _policy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The made-up policy is installed."""
    folder = tmp_path_factory.mktemp("entrances") / "site"
    with pytest.MonkeyPatch.context() as patch, made_up_site(folder, entrances.PLUGINS, patch) as site:
        site.add("far-policy", "far_policy.py")
        yield


def test_each_row_has_its_messages() -> None:
    assert read_rows().keys() == ROWS.keys() | {"clouds", "dense clouds"}


@pytest.mark.usefixtures("_policy")
@pytest.mark.parametrize("row", ROWS)
def test_messages_to_the_world_keep_the_arm_off_the_wall(row: str, tmp_path: Path) -> None:
    told, answers = Told(tmp_path), {"refused": 0, "taken": 0}
    try:
        for send in ROWS[row](told):
            told.tick()
            try:
                send()
            except IbrobotError:
                answers["refused"] += 1
            else:
                answers["taken"] += 1
        told.tick(200)
        told.check_wall()
        assert not told.run.session.held
        assert told.run.commands[-1][told.entrance.column] > 0.5, "it has come near the wall"
        other = "taken" if read_rows()[row] == "refused" else "refused"
        assert answers[other] == 0
        assert answers[read_rows()[row]] >= LEAST[row]
    finally:
        told.entrance.close()


AXES = tuple(PointField(axis, 4 * number, 7) for number, axis in enumerate("xyz"))


def cloud(points: Any, frame: str = "base", **changed: Any) -> PointCloud2:
    data = np.asarray(points, dtype="<f4")
    fields: dict[str, Any] = {"height": 1, "width": len(data), "fields": AXES, "row_step": 12 * len(data)} | changed
    return PointCloud2(Header(0, frame), is_bigendian=False, point_step=12, data=data.ravel().view(np.uint8), **fields)


class Seeing(Told):
    """With a sensor, whose cloud is too old after half a second."""

    overrides = ("world.clouds={lidar: {topic: /points, least_points: 1, max_age: 0.5, rate: 30, cell: 0.01}}",)

    def see(self, message: PointCloud2, ticks: int = 5) -> None:
        self.run.session.bus.publish("/points", message)
        self.run.ticks(ticks)

    @property
    def refused(self) -> int:
        """Messages of the sensor that could not be used, as the run counts them."""
        return sum(observed_world(self.run.session.bus).ages["lidar"].refused.values())


POINTS = np.array([[0.6, y, 0.3] for y in np.linspace(-0.3, 0.3, 200)])


def wrong_clouds() -> Iterator[PointCloud2]:
    """Of unknown frames, without a measurement, or whose sizes do not fit."""
    for frame in ("map", "", "lidar", "base ", "Base", "\0", "x" * 10_000):
        yield cloud(POINTS, frame)
    for value in (np.nan, np.inf, -np.inf, 0.0, 1e30, -3e38):
        yield cloud(np.full((200, 3), value))
    yield cloud(np.zeros((0, 3)))
    for changed in (
        {"height": 0}, {"width": 2**31}, {"height": 10**9, "width": 1}, {"row_step": 0}, {"fields": ()},
        {"fields": AXES[:2]}, {"width": 201},
    ):  # fmt: skip
        yield cloud(POINTS, **changed)


@pytest.mark.usefixtures("_policy")
def test_a_cloud_that_cannot_be_used_is_refused_and_the_arm_holds_once_it_is_too_old(tmp_path: Path) -> None:
    told, sent = Seeing(tmp_path), 0
    try:
        told.see(cloud(POINTS))
        for message in wrong_clouds():
            before = told.refused
            told.see(message)
            assert told.refused == before + 1, message
            sent += 1
        assert sent >= 20
        rest = told.run.commands[-1]
        told.tick(20)
        assert np.array_equal(told.run.commands[-1], rest), "it holds"
        for _ in range(20):
            told.see(cloud(POINTS))
            told.tick(20)
        told.check_wall()
        assert told.run.commands[-1][told.entrance.column] > 0.5, "it goes on"
        assert read_rows()["clouds"] == "refused"
    finally:
        told.entrance.close()


@pytest.mark.usefixtures("_policy")
def test_clouds_of_20000_cells_that_move_are_kept_off(tmp_path: Path) -> None:
    """A floor of the room beside the table, which waves, and a wall of cells before the one of the run."""
    told = Seeing(tmp_path)
    grid = np.array(list(itertools.product(np.arange(-0.745, 0.75, 0.01), repeat=2)))
    wall = np.array([[x, -0.13, z] for x in np.arange(0.06, 0.2, 0.01) for z in np.arange(0.01, 0.2, 0.01)])
    try:
        for number in range(5):
            waves = 0.6 + 0.1 * np.sin(10 * grid[:, :1] + number)
            told.see(cloud(np.concatenate([np.concatenate([grid, waves], axis=1), wall])))
            told.tick(20)
        cells = observed_world(told.run.session.bus).world.objects["lidar"].shape
        assert isinstance(cells, Voxels)
        assert len(cells.cells) > 15_000
        guard = told.run.session.control.call(GetCounters())["guard"]
        assert guard["ticks"] > 0
        told.check_wall()
        only = WorldObject(Voxels(cells.size, cells.cells[cells.centres[:, 2] < 0.3]))
        arm = may_touch_arm(told.run.session.config.robot, told.run.session.log)
        checks = Collisions(arm, World({"cells": only}), arm.joint_names)
        assert checks.free(told.run.commands[-1])
        assert read_rows()["dense clouds"] == "taken"
    finally:
        told.entrance.close()


@pytest.mark.usefixtures("_policy")
def test_every_change_is_known_within_two_ticks(tmp_path: Path) -> None:
    told = Told(tmp_path)
    box: dict[str, Any] = {"shape": "box", "size": [0.02] * 3}
    changes: dict[str, Message] = {
        "add": told.add(**box), "replace": told.add(**{**box, "position": [0.6, 0.6, 0.6]}), "move": told.move(),
        "touch": partial(told.call, "/world/touch", {"objects": ["it"]}),
        "allow": partial(told.call, "/world/allow", {"name": "it", "may_touch": ["wall"]}),
        "attach": partial(told.call, "/world/attach", {"name": "it", "link": _LINK}),
        "detach": partial(told.call, "/world/detach", {"name": "it"}),
        "remove": partial(told.call, "/world/remove", {"name": "it"}),
    }  # fmt: skip

    def known() -> int:
        return int(told.run.session.control.call(GetCounters())["guard"]["world_changes"])

    try:
        for name, change in changes.items():
            before = known()
            change()
            told.tick(2)
            assert known() == before + 1, name
    finally:
        told.entrance.close()


@pytest.mark.usefixtures("_policy")
def test_an_evaluation_counts_what_the_guard_has_changed(tmp_path: Path) -> None:
    told = Told(tmp_path)
    try:
        told.tick(10)
        assert "guard" not in interventions(told.run.session)
        told.tick(200)
        assert interventions(told.run.session)["guard"] > 10
    finally:
        told.entrance.close()
