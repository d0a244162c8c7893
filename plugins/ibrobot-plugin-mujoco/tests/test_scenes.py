"""Every scene: conformance, with all that it can draw; its expert; and what each predicate takes for success."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, override

import mujoco
import numpy as np
from ibrobot_mujoco.model import build_spec
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.spans import ends
from ibrobot_mujoco.world import World
from ibrobot_testing import SceneSuite

from ibrobot_core.api import Context, Robot, Scene, SceneConfig, Vector

LOOKS: Mapping[str, Any] = {
    "friction": (0.7, 1.2),
    "light": (0.5, 1.5),
    "camera_shift": (-0.02, 0.02),
    "camera_turn": (-0.05, 0.05),
    "distractors": 2,
}
"""All that every scene can draw."""


class _Suite(SceneSuite[mujoco.MjSpec, World]):
    """A scene around the SO-101 in its rest pose."""

    type: ClassVar[str]
    options: ClassVar[Mapping[str, Any]] = {}

    def config(self, **more: Any) -> SceneConfig:
        return scene(self.type, **{**LOOKS, **self.options, **more})

    def robot(self) -> Robot:
        return so101()

    @override
    def make(self, ctx: Context) -> Scene[mujoco.MjSpec, World]:
        return self.config().make(self.robot())

    @override
    def world(self, scene: Scene[mujoco.MjSpec, World], ctx: Context) -> World:
        spec, _ = build_spec(MujocoOptions(scene=_Given.of(scene)), self.robot())
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
            model.geom_size, model.geom_rbound, model.geom_rgba, model.geom_friction, model.body_mass,
            model.light_diffuse, model.cam_pos, model.cam_quat, world.data.mocap_pos,
        )  # fmt: skip
        return np.concatenate([np.ravel(part) for part in parts])

    @override
    def advance(self, world: World, duration_s: float) -> None:
        mujoco.mj_step(world.model, world.data, round(duration_s / world.model.opt.timestep))

    @override
    def ranges(self, scene: Scene[mujoco.MjSpec, World]) -> Mapping[str, tuple[float, float]]:
        options = self.config().options
        given = {name: ends(getattr(options, name)) for name in scene.factors if hasattr(options, name)}
        cameras = dict.fromkeys(("camera_x", "camera_y", "camera_z"), ends(options.camera_shift))
        turns = dict.fromkeys(("camera_roll", "camera_pitch", "camera_yaw"), ends(options.camera_turn))
        return {**given, **cameras, **turns}

    @override
    def fixed(self, ctx: Context) -> tuple[str, Scene[mujoco.MjSpec, World]]:
        return "light", self.config(light=1.0).make(self.robot())


class _Given:
    """A scene that exists already, in the place of its config."""

    @classmethod
    def of(cls, made: Scene[mujoco.MjSpec, World]) -> Any:
        given = cls()
        given.make = lambda robot: made  # type: ignore[attr-defined]
        return given


class TestEmpty(_Suite):
    type = "empty"
    task = False


class TestPickCube(_Suite):
    type = "pick_cube"
    options: ClassVar = {"cube_size": (0.02, 0.03), "cube_colour": (0.0, 1.0)}


class TestPush(_Suite):
    type = "push"
    options: ClassVar = {"block_size": (0.03, 0.04), "block_colour": (0.0, 1.0)}


class TestStack(_Suite):
    type = "stack"
    options: ClassVar = {"cube_size": (0.02, 0.025), "base_size": (0.03, 0.035), "base_colour": (0.4, 0.6)}


class TestSort(_Suite):
    type = "sort"
    options: ClassVar = {"cube_size": (0.02, 0.025), "cubes": 3}
