"""Planning problems for the SO-101 in five kinds of scenes, in the manner of MotionBenchMaker, seeded.

Chamzas et al., "MotionBenchMaker: a tool to generate and benchmark motion planning datasets", 2022. A problem is a
world, a start and a goal, both free, with a straight line between them that is blocked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path

import attrs
import numpy as np
import so101_nexus
from ibrobot_kinematics import read_mjcf
from ibrobot_planning.planners.search import Space
from ibrobot_planning.world.arm import Arm, read_arm
from ibrobot_planning.world.collision import Collisions, unchecked_pairs
from ibrobot_planning.world.objects import Box, Cylinder, World, WorldObject

from ibrobot_core.api import Description, Joint, Pose, Quaternion, Robot, Vector, Vector3

MJCF = Path(so101_nexus.__file__).parent / "assets/SO101_menagerie/so101.xml"
ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
JOINTS = (*ARM_JOINTS, "gripper")
PADDING_M = 0.005
MAX_VELOCITY, MAX_ACCELERATION = 3.0, 10.0
"""As in the study that came before, [rad/s] and [rad/s^2]."""
_LIMITS = ((-1.91986, 1.91986), (-1.74533, 1.74533), (-1.69, 1.69), (-1.65806, 1.65806), (-2.74385, 2.74385))
_SAMPLES = 4000


def so101() -> Robot:
    """The arm with the limits of the study."""
    limits = (*_LIMITS, (-0.17453, 1.74533))
    joints = tuple(
        Joint(name, lower, upper, max_velocity=MAX_VELOCITY, max_acceleration=MAX_ACCELERATION)
        for name, (lower, upper) in zip(JOINTS, limits, strict=True)
    )
    return Robot(name="so101", joints=joints, groups={"arm": ARM_JOINTS}, description=Description(mjcf=MJCF))


def arm() -> Arm:
    """Its collision model, within these limits."""
    robot = so101()
    return attrs.evolve(read_arm(MJCF, JOINTS), lower=robot.lower, upper=robot.upper)


@attrs.frozen(eq=False)
class Problem:
    """From `start` to `goal`, both shape (5,) [rad], in `world`."""

    kind: str
    seed: int
    world: World
    start: Vector
    goal: Vector


def box(x: float, y: float, z: float, sx: float, sy: float, sz: float, yaw: float = 0.0) -> WorldObject:
    """A box with its middle at a place, and sizes [m], turned about the vertical axis [rad]."""
    turn = Quaternion(0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
    return WorldObject(Box((float(sx), float(sy), float(sz))), Pose(Vector3(float(x), float(y), float(z)), turn))


def _table() -> dict[str, WorldObject]:
    return {"table": box(0.15, 0, -0.016, 0.9, 0.9, 0.02)}


def _placed(parts: Mapping[str, tuple[float, ...]], x: float, y: float, z: float, yaw: float) -> dict[str, WorldObject]:
    """Boxes given in a frame of their own, as x, y, z and sizes."""
    c, s = np.cos(yaw), np.sin(yaw)
    return {
        name: box(x + c * px - s * py, y + s * px + c * py, z + pz, sx, sy, sz, yaw)
        for name, (px, py, pz, sx, sy, sz) in parts.items()
    }


type Scene = tuple[dict[str, WorldObject], list[tuple[Vector, Vector]]]
"""Objects besides the table, and the boxes (corners) in which the tool is at the ends; two at least."""
type Random = np.random.Generator


def _table_pick(rng: Random) -> Scene:
    """Two places on a table between cans and boxes."""
    things: dict[str, WorldObject] = {}
    regions = []
    for i, heading in enumerate(rng.permutation(np.linspace(-1.1, 1.1, 6))):
        away = rng.uniform(0.19, 0.3)
        x, y = 0.04 + away * np.cos(heading), away * np.sin(heading)
        if i < 2:
            regions.append((np.array([x - 0.05, y - 0.05, 0.02]), np.array([x + 0.05, y + 0.05, 0.1])))
            continue
        height = rng.uniform(0.1, 0.26)
        if rng.random() < 0.5:
            shape = Cylinder(float(rng.uniform(0.015, 0.03)), float(height))
            things[f"can_{i}"] = WorldObject(shape, Pose(Vector3(float(x), float(y), float(height / 2))))
        else:
            width, depth = rng.uniform(0.03, 0.06, 2)
            things[f"box_{i}"] = box(x, y, height / 2, width, depth, height, rng.uniform(0, np.pi))
    return things, regions


def _under_table(rng: Random) -> Scene:
    """Below and above a low table with four legs."""
    top, x = rng.uniform(0.2, 0.26), rng.uniform(0.24, 0.28)
    y, yaw = rng.uniform(-0.08, 0.08), rng.uniform(-0.2, 0.2)
    depth, width = 0.22, rng.uniform(0.28, 0.36)
    parts: dict[str, tuple[float, ...]] = {"top": (0, 0, top, depth, width, 0.02)}
    for i, (a, b) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
        parts[f"leg_{i}"] = (a * (depth / 2 - 0.01), b * (width / 2 - 0.01), top / 2, 0.02, 0.02, top)
    below = np.array([x - 0.06, y - 0.1, 0.03]), np.array([x + 0.08, y + 0.1, top - 0.04])
    above = np.array([x - 0.08, y - 0.15, top + 0.04]), np.array([x + 0.1, y + 0.15, top + 0.16])
    return _placed(parts, x, y, 0, yaw), [below, above]


def _open_box(rng: Random) -> Scene:
    """Inside an open box, and beside it."""
    x, y, yaw = rng.uniform(0.2, 0.25), rng.uniform(-0.16, 0.16), rng.uniform(-0.4, 0.4)
    depth, width, height = rng.uniform(0.14, 0.18), rng.uniform(0.14, 0.2), rng.uniform(0.08, 0.13)
    wall, half = 0.008, height / 2
    parts = {
        "front": (-depth / 2, 0, half, wall, width, height),
        "back": (depth / 2, 0, half, wall, width, height),
        "left": (0, width / 2, half, depth, wall, height),
        "right": (0, -width / 2, half, depth, wall, height),
    }
    inside = np.array([x - 0.05, y - 0.05, 0.02]), np.array([x + 0.05, y + 0.05, 0.6 * height])
    side = -np.sign(y) or 1.0
    corners = np.array([[0.1, side * 0.12, 0.02], [0.3, side * 0.3, 0.1]])
    return _placed(parts, x, y, 0, yaw), [inside, (corners.min(axis=0), corners.max(axis=0))]


def _bookshelf(rng: Random) -> Scene:
    """Two of the six compartments of a shelf."""
    x, y, yaw = rng.uniform(0.31, 0.34), rng.uniform(-0.05, 0.05), rng.uniform(-0.15, 0.15)
    depth, width, height = 0.12, rng.uniform(0.3, 0.36), 0.36
    boards = np.array([0.14, 0.28]) + rng.uniform(-0.02, 0.02, 2)
    half = height / 2
    parts = {f"board_{i}": (0.0, 0.0, z, depth, width, 0.01) for i, z in enumerate((*boards, height))} | {
        "back": (depth / 2, 0, half, 0.01, width, height),
        "left": (0, width / 2, half, depth, 0.01, height),
        "right": (0, -width / 2, half, depth, 0.01, height),
        "divider": (0.01, rng.uniform(-0.03, 0.03), half, depth - 0.02, 0.01, height),
    }
    floors, regions = (0.0, *boards), []
    for row, column in rng.permutation([(r, c) for r in range(3) for c in (-1, 1)])[:2]:
        low, high, side = floors[row] + 0.03, (*boards, height)[row] - 0.03, y + column * width / 4
        regions.append((np.array([x - 0.05, side - 0.06, low]), np.array([x + 0.04, side + 0.06, high])))
    return _placed(parts, x, y, 0, yaw), regions


def _cage(rng: Random) -> Scene:
    """Two gaps of a cage of nine bars and two rings, which the gripper reaches through."""
    things: dict[str, WorldObject] = {}
    number, radius, bar = 9, rng.uniform(0.2, 0.23), 0.012
    headings = np.linspace(-1.7, 1.7, number) + rng.uniform(-0.05, 0.05)
    for i, heading in enumerate(headings):
        place = Pose(Vector3(float(0.04 + radius * np.cos(heading)), float(radius * np.sin(heading)), 0.17))
        things[f"bar_{i}"] = WorldObject(Cylinder(bar / 2, 0.34), place)
    for i, z in enumerate((rng.uniform(0.15, 0.19), 0.34)):
        for k, (a, b) in enumerate(pairwise(headings)):
            mid, reach, side = (a + b) / 2, radius * np.cos((b - a) / 2), 2 * radius * np.sin((b - a) / 2)
            things[f"ring_{i}_{k}"] = box(0.04 + reach * np.cos(mid), reach * np.sin(mid), z, bar, side, bar, mid)
    regions = []
    for gap in rng.permutation(number - 1)[:2]:
        mid = (headings[gap] + headings[gap + 1]) / 2
        x, y = 0.04 + (radius + 0.05) * np.cos(mid), (radius + 0.05) * np.sin(mid)
        regions.append((np.array([x - 0.04, y - 0.04, 0.03]), np.array([x + 0.04, y + 0.04, 0.3])))
    return things, regions


_SCENES: dict[str, Callable[[Random], Scene]] = {
    "table_pick": _table_pick,
    "under_table": _under_table,
    "box": _open_box,
    "bookshelf": _bookshelf,
    "cage": _cage,
}
KINDS = tuple(_SCENES)


class Maker:
    """Makes problems; holds what all of them share."""

    def __init__(self) -> None:
        made = arm()
        self.arm = attrs.evolve(made, unchecked=unchecked_pairs(made))
        self._model = read_mjcf(MJCF).chain("gripperframe", ARM_JOINTS)

    def checks(self, world: World, padding: float = PADDING_M) -> Collisions:
        """The planner's own checks."""
        return Collisions(self.arm, world, ARM_JOINTS, padding=padding)

    def problem(self, kind: str, seed: int) -> Problem:
        """Problem number `seed` of a kind."""
        rng = np.random.default_rng([KINDS.index(kind), seed])
        lower, upper = np.array(_LIMITS).T
        while True:
            things, regions = _SCENES[kind](rng)
            scene = World({**_table(), **things})
            checks = self.checks(scene, 1.2 * PADDING_M)
            space = Space(checks, lower, upper, 0.01)
            ends = [self._within(checks, region, rng) for region in regions[:2]]
            if any(end is None for end in ends):
                continue
            start, goal = (end for end in ends if end is not None)
            if rng.random() < 0.5:
                start, goal = goal, start
            if not space.free(start, goal):
                return Problem(kind, seed, scene, start, goal)

    def _within(self, checks: Collisions, region: tuple[Vector, Vector], rng: np.random.Generator) -> Vector | None:
        """A free configuration with the tool in a region, not at the very limits."""
        lower, upper = np.array(_LIMITS).T * 0.97
        samples = rng.uniform(lower, upper, (_SAMPLES, len(ARM_JOINTS)))
        tips = self._model_tips(samples)
        for q in samples[((tips > region[0]) & (tips < region[1])).all(axis=1)]:
            if checks.free(q):
                return np.asarray(q)
        return None

    def _model_tips(self, samples: Vector) -> Vector:
        """Positions of the tool, shape (N, 3)."""
        return self._model.forward(samples).position
