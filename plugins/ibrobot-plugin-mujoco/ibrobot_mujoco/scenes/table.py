"""Base of all scenes: light, friction and cameras by factors, distractors, and clear placement of objects."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import ClassVar, override

import mujoco
import numpy as np

from ibrobot_core.api import HardwareError, Robot, Vector
from ibrobot_mujoco.scene import Scene
from ibrobot_mujoco.scenes.options import SceneOptions
from ibrobot_mujoco.scenes.solids import FRICTION, add_cube, hue, resize_cube
from ibrobot_mujoco.spans import Span, ends
from ibrobot_mujoco.world import World, bodies_of

TABLE = "table"
CLEARANCE = 0.03
"""Minimum distance between an object's initial pose and everything except the table [m]."""
REST_SPEED = 0.05
"""Speed below which an object counts as at rest [m/s]."""
CARRIED_M = 0.01
"""Height of a body's lowest corner above the table from which it counts as carried if only the robot touches it [m]."""
_TRIES = 1000
_CAMERA = tuple(f"camera_{axis}" for axis in ("x", "y", "z", "roll", "pitch", "yaw"))
_SHAPES = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE)
_APART = (0.13, 0.36)
"""Distances of distractors from the base's origin [m]."""

type Draw = Callable[[], tuple[float, float, float, float]]
"""Draws x, y, z [m] and yaw [rad]."""


class TableScene[O: SceneOptions](Scene[mujoco.MjSpec, World]):
    """A table without a task; the base class of this package's scenes.

    A task is a history, not only a final state: `success` is asked in every tick of control, and notes what happens.

    Attributes:
        moving: the bodies that move; their poses, position [m] and quaternion wxyz, begin the observation.
        further: names of further observations, in order.
        placed: names of the factors that `arrange` returns.
        sizes: factor of an edge -> cubes that have it.
        colours: factor of a hue -> geoms that have it.
    """

    moving: tuple[str, ...] = ()
    further: tuple[str, ...] = ()
    placed: tuple[str, ...] = ()
    sizes: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    colours: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def __init__(self, options: O, robot: Robot) -> None:
        self.options = options
        self._robot = robot
        self._look = {name: ends(getattr(options, name)) for name in (*self.sizes, *self.colours, "friction", "light")}
        shift, turn = ends(options.camera_shift), ends(options.camera_turn)
        self._look |= dict(zip(_CAMERA, (shift,) * 3 + (turn,) * 3, strict=True))
        self._distractors = [f"distractor{i + 1}" for i in range(options.distractors)]
        self._of_robot: dict[str, frozenset[int]] = {}
        self._carried: set[str] = set()
        """Bodies of `moving` that the robot has carried in this episode."""
        self._originals: tuple[mujoco.MjModel, mujoco.MjModel] | None = None
        """A model that factors modify, and a copy of it as it was compiled."""
        self.factors = (*self.placed, *self._look, "distractors")
        poses = (f"{body}.{part}" for body in self.moving for part in ("x", "y", "z", "qw", "qx", "qy", "qz"))
        self.values = (*poses, *self.further)
        self.poses = {body: 7 * i for i, body in enumerate(self.moving)}

    def add(self, spec: mujoco.MjSpec) -> None:
        """Add the objects of the task: the cubes of `sizes`, and what subclasses add."""
        for name, cubes in self.sizes.items():
            for cube in cubes:
                add_cube(spec, cube, ends(getattr(self.options, name))[0])

    def arrange(self, world: World, rng: np.random.Generator, look: Mapping[str, float]) -> Sequence[float]:
        """Place the objects of the task; returns the values of `placed`."""
        return ()

    @override
    def build(self, spec: mujoco.MjSpec) -> None:
        self.add(spec)
        for i, name in enumerate(self._distractors):
            _add_distractor(spec, name, i)

    @override
    def begin(self, world: World, rng: np.random.Generator) -> Vector:
        self._carried = set()
        look_rng, aside = rng.spawn(2)
        drawn = zip(self._look.items(), look_rng.random(len(self._look)).tolist(), strict=True)
        look = {name: float(low + u * (high - low)) for (name, (low, high)), u in drawn}
        free = [*self.moving, *self._distractors]
        for body in free:  # until it is placed, it is in nobody's way
            world.put(body, np.array([0, 0, -1.0, 1, 0, 0, 0]))
        values = dict(look)
        self._apply(world, values)
        if self.sizes:
            _recompute(world)
        values |= dict(zip(self.placed, self.arrange(world, rng, look), strict=True))
        for body in self._distractors:
            self.place(world, body, partial(_aside, aside, world.model.geom(body).size), "distractors")
        values["distractors"] = len(self._distractors)
        factors = np.array([values[name] for name in self.factors])
        self.show(world, factors)
        return factors

    @override
    def show(self, world: World, factors: Vector) -> None:
        self._apply(world, dict(zip(self.factors, factors.tolist(), strict=True)))

    def _apply(self, world: World, values: Mapping[str, float]) -> None:
        model = world.model
        if self._originals is None or self._originals[0] is not model:
            self._originals = model, copy.copy(model)
        original = self._originals[1]
        light = values["light"]
        model.geom_friction[:, 0] = values["friction"] * original.geom_friction[:, 0]
        model.light_diffuse[:] = light * original.light_diffuse
        model.light_ambient[:] = light * original.light_ambient
        model.vis.headlight.ambient[:] = light * original.vis.headlight.ambient
        model.vis.headlight.diffuse[:] = light * original.vis.headlight.diffuse
        _move_cameras(model, original, [values[name] for name in _CAMERA])
        for name, cubes in self.sizes.items():
            for cube in cubes:
                resize_cube(model, cube, values[name])
        for name, geoms in self.colours.items():
            for geom in geoms:
                model.geom(geom).rgba = hue(values[name])

    @override
    def observe(self, world: World, out: Vector) -> None:
        for body, first in self.poses.items():
            out[first : first + 7] = world.pose(body)

    @override
    def success(self, world: World) -> bool | None:
        return None

    def touched(self, world: World, body: str, arm: str = "") -> bool:
        """Whether the robot touches a body, or only one of its arms: that with the prefix `arm`."""
        return not self._bodies_of(world, arm).isdisjoint(touching(world, body))

    def carried(self, world: World) -> set[str]:
        """The bodies of `moving` that the robot has carried so far: it alone touched them, clear of the table.

        What was only pushed, hit or dropped is not among them. Call it in each tick.
        """
        robot = self._bodies_of(world)
        for body in self.moving:
            around = touching(world, body)
            if body not in self._carried and around and around <= robot and height(world, body) > CARRIED_M:
                self._carried.add(body)
        return self._carried

    def _bodies_of(self, world: World, arm: str = "") -> frozenset[int]:
        """The bodies of the robot, or of one of its arms."""
        if arm not in self._of_robot:
            joints = [name for name in self._robot.joint_names if name.startswith(arm)]
            self._of_robot[arm] = bodies_of(world.model, joints)
        return self._of_robot[arm]

    def at_rest(self, world: World, body: str) -> bool:
        """Whether a body is at rest, and the robot does not touch it."""
        return world.speed(body) <= REST_SPEED and not self.touched(world, body)

    def place(self, world: World, body: str, draw: Draw, options: str, apart: float = CLEARANCE) -> Vector:
        """Place a body at random on the table, clear of everything else; returns x, y, z [m] and yaw [rad].

        Raises:
            HardwareError: if the options leave no such place.
        """
        own = {world.model.body(body).id}
        for _ in range(_TRIES):
            x, y, z, yaw = draw()
            world.put(body, np.array([x, y, z, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]))
            if self.is_clear(world, own, apart):
                return np.array([x, y, z, yaw])
        raise HardwareError(
            f"found no place for the {body} {apart} m clear of robot and objects in {_TRIES} tries: "
            f"{options} must leave one"
        )

    def place_cube(
        self, world: World, body: str, rng: np.random.Generator, size: float, of: str = "cube"
    ) -> tuple[float, float, float]:
        """Place a cube of edge `size` [m] by the options `OF_distance`, `OF_bearing` and `OF_yaw`.

        Returns:
            x, y [m] and yaw [rad].

        Raises:
            HardwareError: if the options leave no place.
        """
        distance, bearing, yaw = (getattr(self.options, f"{of}_{name}") for name in ("distance", "bearing", "yaw"))
        options = f"{of}_distance {list(distance)} and {of}_bearing {list(bearing)}"
        x, y, _, turn = self.place(world, body, partial(_polar, rng, distance, bearing, yaw, size), options).tolist()
        return x, y, turn

    @staticmethod
    def is_clear(world: World, bodies: Collection[int], apart: float) -> bool:
        """Whether everything but the table is at least `apart` [m] away from some bodies, by their ids."""
        model, data = world.model, world.data
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        own = np.isin(model.geom_bodyid, list(bodies))
        solid[model.geom(TABLE).id] = False
        mine, others = np.flatnonzero(solid & own).tolist(), np.flatnonzero(solid & ~own).tolist()
        mujoco.mj_kinematics(model, data)
        return all(
            mujoco.mj_geomDistance(model, data, geom, other, apart, None) >= apart for geom in mine for other in others
        )


def touching(world: World, body: str) -> set[int]:
    """The bodies that touch a body."""
    own = world.model.body(body).id
    pairs = world.model.geom_bodyid[world.data.contact.geom]
    return set(pairs[(pairs == own).any(axis=1)].ravel().tolist()) - {own}


def height(world: World, body: str) -> float:
    """Height of the lowest corner of a box, whose geom has the name of its body, above the table [m]."""
    position, turn = world.data.geom(body).xpos, world.data.geom(body).xmat
    return float(position[2] - np.abs(turn[6:]) @ world.model.geom(body).size)


def _polar(
    rng: np.random.Generator, distance: Span, bearing: Span, yaw: Span, size: float
) -> tuple[float, float, float, float]:
    """Draw a place on the table for a cube of edge `size` [m]."""
    radius, angle = rng.uniform(*ends(distance)), rng.uniform(*ends(bearing))
    turn = rng.uniform(*ends(yaw))
    return radius * math.cos(angle), radius * math.sin(angle), size / 2, turn


def _aside(rng: np.random.Generator, size: Vector) -> tuple[float, float, float, float]:
    radius, angle, yaw = rng.uniform(*_APART), rng.uniform(-1.4, 1.4), rng.uniform(-math.pi, math.pi)
    return radius * math.cos(angle), radius * math.sin(angle), float(size[1] or size[0]), yaw


def _add_distractor(spec: mujoco.MjSpec, name: str, number: int) -> None:
    half = 0.010 + 0.002 * (number % 4)
    body = spec.worldbody.add_body(name=name, pos=[0, 0, -1])
    body.add_freejoint(name=name)
    shape = _SHAPES[number % len(_SHAPES)]
    size = [half, 0.0 if shape == mujoco.mjtGeom.mjGEOM_SPHERE else half, half]
    # Rolling friction keeps balls and cylinders where they are.
    body.add_geom(
        name=name, type=shape, size=size, density=1000.0, condim=6, friction=[*FRICTION[:2], 0.01],
        rgba=hue(0.35 + 0.618 * number),
    )  # fmt: skip


def _recompute(world: World) -> None:
    """Recompute what depends on masses; MuJoCo does it in the reference state."""
    kept = world.data.qpos.copy()
    mujoco.mj_setConst(world.model, world.data)
    world.data.qpos[:] = kept


def _move_cameras(model: mujoco.MjModel, original: mujoco.MjModel, offsets: Sequence[float]) -> None:
    turn, turned = np.empty(4), np.empty(4)
    mujoco.mju_euler2Quat(turn, np.array(offsets[3:]), "XYZ")
    for camera in np.flatnonzero(model.cam_bodyid == 0):
        mujoco.mju_mulQuat(turned, turn, original.cam_quat[camera])
        model.cam_quat[camera] = turned
        model.cam_pos[camera] = original.cam_pos[camera] + offsets[:3]
