"""The conformance suite of scenes in MuJoCo, and a small scene; both need `ibrobot-testing`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, override

import mujoco
import numpy as np

from ibrobot_core.api import Context, Robot, Vector
from ibrobot_mujoco.model import build_spec
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scene import Scene
from ibrobot_mujoco.scene_suite import SceneSuite
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.world import World


class MujocoSceneSuite(SceneSuite[mujoco.MjSpec, World]):
    """Checks of every scene in MuJoCo, around an arm in its pose `rest`. The subclass defines `make` and `ranges`."""

    def robot(self) -> Robot:
        """The robot; by default the SO-101."""
        return so101()

    @override
    def world(self, scene: Scene[mujoco.MjSpec, World], ctx: Context) -> World:
        spec, _ = build_spec(MujocoOptions(scene=_given(scene)), self.robot())
        world = World.of(spec.compile())
        self._rest(world)
        return world

    def _rest(self, world: World) -> None:
        robot = self.robot()
        for name, position in zip(robot.joint_names, robot.pose("rest"), strict=True):
            world.data.joint(name).qpos = world.data.actuator(name).ctrl = position
        mujoco.mj_forward(world.model, world.data)

    @override
    def begin(self, scene: Scene[mujoco.MjSpec, World], world: World, seed: int) -> Vector:
        mujoco.mj_resetData(world.model, world.data)
        self._rest(world)
        factors = scene.begin(world, np.random.default_rng(seed))
        mujoco.mj_forward(world.model, world.data)
        return factors

    @override
    def state(self, world: World) -> Vector:
        state: Vector = world.data.qpos.copy()
        return state

    @override
    def looks(self, world: World) -> Vector:
        model = world.model
        parts = (
            model.geom_size,
            model.geom_rbound,
            model.geom_rgba,
            model.geom_friction,
            model.body_mass,
            model.light_diffuse,
            model.cam_pos,
            model.cam_quat,
            world.data.mocap_pos,
        )
        return np.concatenate([np.ravel(part) for part in parts])

    @override
    def advance(self, world: World, duration_s: float) -> None:
        mujoco.mj_step(world.model, world.data, round(duration_s / world.model.opt.timestep))


def _given(made: Scene[mujoco.MjSpec, World]) -> Any:
    """A scene that exists already, in the place of its config."""
    return SimpleNamespace(make=lambda robot: made)


class FakeTableScene(Scene[mujoco.MjSpec, World]):
    """A cube on a table, which has to be pushed beyond a line.

    Args:
        line: distance of the line from the base [m].
    """

    values = ("cube.x", "cube.y", "cube.z", "cube.qw", "cube.qx", "cube.qy", "cube.qz")
    factors = ("cube_x",)
    poses = {"cube": 0}  # noqa: RUF012 - as the interface declares it

    def __init__(self, line: float = 0.3) -> None:
        self._line = line

    @override
    def build(self, spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name="cube")
        body.add_freejoint(name="cube")
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.0125, 0.0125, 0.0125], mass=0.05, rgba=[0.8, 0.2, 0.1, 1])

    @override
    def begin(self, world: World, rng: np.random.Generator) -> Vector:
        x = rng.uniform(0.2, 0.25)
        world.put("cube", np.array([x, 0.0, 0.0125, 1, 0, 0, 0]))
        factors = np.array([x])
        self.show(world, factors)
        return factors

    @override
    def show(self, world: World, factors: Vector) -> None:
        """Nothing but the cube differs between episodes."""

    @override
    def observe(self, world: World, out: Vector) -> None:
        out[:] = world.pose("cube")

    @override
    def success(self, world: World) -> bool | None:
        return bool(world.pose("cube")[0] > self._line) and world.speed("cube") < 0.05
