"""Large meshes for the guard: bodies around them, which control reads and builds between two ticks."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.feed import GuardFeed
from ibrobot_planning.guard.meshes import MOST_TRIANGLES, Meshes, surrounding
from ibrobot_planning.world.coal_shapes import convex_faces
from ibrobot_planning.world.objects import OBSERVED, Boxes, Mesh, ObservedWorld, World, WorldObject

from ibrobot_core.api import HardwareError, Pose, Quaternion, SteppedClock, Vector, Vector3
from ibrobot_core.app import Bus

from .test_guard import ACROSS, LEFT, WALL, Loop, Seen


def grid(rows: int, columns: int, corner: Any, along: Any, across: Any) -> Mesh:
    """A flat rectangle of 2 * rows * columns triangles."""
    at = np.stack(np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij"), axis=-1)
    vertices = np.asarray(corner) + at.reshape(-1, 2) @ np.array([along, across], dtype=float)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    squares = np.stack([first, first + 1, first + columns + 1, first + columns + 2], axis=1)
    return Mesh(vertices, np.concatenate([squares[:, (0, 1, 2)], squares[:, (1, 3, 2)]]))


def together(*meshes: Mesh) -> Mesh:
    begins = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + begin for mesh, begin in zip(meshes, begins.tolist(), strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles))


def soup(rng: np.random.Generator, count: int, size: float) -> Mesh:
    """Triangles anywhere, of all sizes."""
    middles, scales = rng.normal(size=(count, 1, 3)), size * rng.exponential(size=(count, 1, 1))
    return Mesh((middles + scales * rng.normal(size=(count, 3, 3))).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


MESHES = {
    "a plate": grid(40, 40, (0, 0, 0), (1, 0, 0), (0, 1, 0)),
    "a tilted plate of slivers": grid(900, 1, (5, 1, 0), (0.3, 0.4, 0.5), (0.6, -0.2, 0)),
    "a plate far away": grid(40, 40, (1e6, 0, 0), (1, 0, 0), (0, 1, 0)),
    "a tiny plate": grid(40, 40, (0, 0, 0), (1e-4, 0, 0), (0, 1e-4, 0)),
    "small triangles": soup(np.random.default_rng(0), 3000, 0.01),
    "large triangles": soup(np.random.default_rng(1), 1500, 1.0),
    "the same triangle, often": Mesh(np.eye(3), np.tile([[0, 1, 2]], (2000, 1))),
}


def outside(boxes: Boxes, points: Vector) -> float:
    """How far points, shape (N, 3), are outside of all boxes, at most [m]; not positive if all are inside."""
    axes, middles = boxes.placements[:, 1:], boxes.placements[:, 0]
    best = np.full(len(points), np.inf)
    for axis, middle, size in zip(axes, middles, boxes.sizes, strict=True):
        left = best > 0  # in no box yet
        best[left] = np.minimum(best[left], (np.abs((points[left] - middle) @ axis.T) - size / 2).max(axis=1))
    return float(best.max())


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES)
def test_every_point_of_a_mesh_is_in_a_box(mesh: Mesh) -> None:
    boxes = surrounding(mesh)
    assert isinstance(boxes, Boxes)
    assert len(boxes.sizes) <= 1024
    rng = np.random.default_rng(2)
    corners = mesh.vertices[mesh.triangles[rng.integers(len(mesh.triangles), size=3000)]]
    shares = rng.dirichlet((0.4, 0.4, 0.4), 3000)
    points = np.concatenate([(shares[:, :, None] * corners).sum(axis=1), mesh.vertices])
    assert outside(boxes, points) < 1e-12 + 1e-9 * np.abs(mesh.vertices).max()


def test_boxes_are_not_much_larger_than_the_mesh() -> None:
    """Two plates, 40 mm apart: nothing is between them."""
    plates = together(*(grid(60, 60, (0, 0, z), (0.5, 0, 0), (0, 0.5, 0)) for z in (0.0, 0.04)))
    boxes = surrounding(plates)
    assert isinstance(boxes, Boxes)
    heights = boxes.corners[:, :, 2]
    assert np.ptp(heights, axis=1).max() < 0.001
    assert np.prod(boxes.sizes, axis=1).sum() < 2 * 0.5 * 0.5 * 0.0003


def test_triangles_that_rounding_leaves_undivided_share_a_box() -> None:
    """No number is between the middles of the last two triangles, so that no plane separates them."""
    alone = np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.0, 0.001, 0.0]])
    one = np.array([[1.0, 0.0, 0.0], [1.0, 0.001, 0.0], [1.0, 0.0, 0.001]])
    other = one + np.array([np.spacing(1.0), 0.0, 0.0])
    boxes = surrounding(Mesh(np.concatenate([alone, one, other]), np.arange(9).reshape(-1, 3)))
    assert isinstance(boxes, Boxes)
    assert len(boxes.sizes) == 2


def test_a_body_around_a_convex_mesh_has_few_corners_and_is_hardly_larger() -> None:
    rng = np.random.default_rng(3)
    for stretch in ((1, 1, 1), (1, 1, 0.1), (1, 0.1, 0.1), (1, 0.5, 0.02)):
        points = rng.normal(size=(20_000, 3))
        points = 0.1 * np.array(stretch) * points / np.linalg.norm(points, axis=1)[:, None]
        body = surrounding(Mesh(points, np.arange(3 * 6666).reshape(-1, 3), convex=True))
        assert isinstance(body, Mesh)
        assert body.convex
        assert len(body.vertices) <= 256
        corners, faces = convex_faces(body.vertices)
        a, b, c = (corners[faces[:, number]] for number in range(3))
        normals = np.cross(b - a, c - a)
        normals *= np.sign(np.einsum("fc,fc->f", normals, a))[:, None] / np.linalg.norm(normals, axis=1)[:, None]
        beyond = max(((points - corner) @ normal).max() for corner, normal in zip(a, normals, strict=True))
        assert beyond < 1e-9
        assert np.abs(body.vertices).max(axis=0) == pytest.approx(0.1 * np.array(stretch), rel=0.02)


def test_a_mesh_that_control_can_read_stays_as_it_is() -> None:
    small, large = grid(20, 20, (0, 0, 0), (1, 0, 0), (0, 1, 0)), MESHES["a plate"]
    meshes = Meshes()
    world = World({"small": WorldObject(small)})
    assert meshes.simple(world) is world
    both = World({"small": WorldObject(small), "large": WorldObject(large)})
    simple = meshes.simple(both)
    assert simple.objects["small"] is both.objects["small"]
    assert meshes.simple(both) == simple, "made once"
    with pytest.raises(HardwareError, match=f"a mesh of {len(large.triangles)} triangles"):
        WorldChange.read(WorldChange(both.objects).message())


@pytest.mark.parametrize("convex", [False, True])
def test_the_arm_stops_in_front_of_a_large_mesh(tmp_path: Path, convex: bool) -> None:
    """As in front of the box whose sides it has."""
    low, high = np.array([0.15, -0.01, 0.0]), np.array([0.55, 0.01, 0.3])
    x, _, z = high - low
    sides = together(*(grid(40, 40, (low[0], y, low[2]), (x, 0, 0), (0, 0, z)) for y in (low[1], high[1])))
    mesh = Mesh(sides.vertices, sides.triangles, convex)
    assert len(mesh.triangles) > MOST_TRIANGLES
    at = {}
    for name, shape in (("box", WALL["wall"]), ("mesh", WorldObject(mesh))):
        loop = Loop(tmp_path, LEFT)
        loop.world(dict(Meshes().simple(World({"wall": shape})).objects))
        at[name] = loop.go(ACROSS)[0]
        assert Seen(WALL).distance(loop.position) > 0.002
    assert 0 < at["box"] < LEFT[0] - 0.3
    assert at["mesh"] == pytest.approx(at["box"], abs=0.05)


def test_a_large_mesh_is_sent_once_and_then_only_where_it_is() -> None:
    large, worlds, sent = WorldObject(MESHES["a plate"]), list[ObservedWorld](), list[dict[str, Any]]()
    bus = Bus(SteppedClock(7))
    bus.serve(OBSERVED, lambda _: worlds[-1])
    feed = GuardFeed(SimpleNamespace(bus=bus, change_world=sent.append))
    known = World()
    for number in range(4):
        moved = WorldObject(large.shape, Pose(Vector3(0.01 * number, 0, 0), Quaternion()))
        worlds.append(ObservedWorld(World({"it": moved})))
        feed._update()
        known = WorldChange.read(json.loads(json.dumps(sent[-1]))).apply(known)
        assert known.objects["it"].pose == moved.pose
    assert len(sent) == 4
    assert max(len(json.dumps(each)) for each in sent[1:]) < 200
