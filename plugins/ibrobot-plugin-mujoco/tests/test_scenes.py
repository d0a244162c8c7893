"""Every scene: conformance, with all that it can draw; its expert; and what each predicate takes for success."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar, override

import mujoco
import numpy as np
import pytest
from ibrobot_mujoco.mujoco_scene_suite import MujocoSceneSuite
from ibrobot_mujoco.scene import Scene, SceneConfig
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.spans import ends
from ibrobot_mujoco.world import World

from ibrobot_core.api import Context, HardwareError, Robot
from ibrobot_core.app import ConfigError, find_config, installed_plugins, load_config

LOOKS: Mapping[str, Any] = {
    "friction": (0.7, 1.2),
    "light": (0.5, 1.5),
    "camera_shift": (-0.02, 0.02),
    "camera_turn": (-0.05, 0.05),
    "distractors": 2,
}
"""All that every scene can draw."""


@cache
def two_arms() -> Robot:
    """The robot that the suite asks for at each beginning of an episode."""
    return load_config(find_config("bi_so101_handover", installed_plugins())).robot


class _Suite(MujocoSceneSuite):
    """A scene around the SO-101 in its rest pose."""

    type: ClassVar[str]
    options: ClassVar[Mapping[str, Any]] = {}

    def config(self, **more: Any) -> SceneConfig:
        return scene(self.type, **{**LOOKS, **self.options, **more})

    @override
    def make(self, ctx: Context) -> Scene[mujoco.MjSpec, World]:
        return self.config().make(self.robot())

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


class TestDrawer(_Suite):
    type = "drawer"
    options: ClassVar = {"drawer_colour": (0.0, 0.3), "drawer_damping": (1.0, 4.0)}


class TestHandover(_Suite):
    type = "handover"
    options: ClassVar = {"bar_colour": (0.0, 0.5)}

    @override
    def robot(self) -> Robot:
        return two_arms()


def test_handover_needs_two_arms() -> None:
    with pytest.raises(HardwareError, match=r"handover needs robot.description.arms left_ and right_, got none"):
        scene("handover").make(so101())


def begun(type_: str, seed: int = 0, **options: Any) -> tuple[World, Scene[mujoco.MjSpec, World]]:
    """A scene at the start of an episode."""
    suite = _Suite()
    made = scene(type_, **options).make(suite.robot())
    world = suite.world(made, suite.context())
    suite.begin(made, world, seed)
    return world, made


def carry(world: World, made: Scene[mujoco.MjSpec, World], *bodies: str) -> None:
    """Have the hand hold bodies in the air for a tick, one after the other."""
    for body in bodies:
        where = world.pose(body)
        put(world, body, tuple(world.data.site("gripperframe").xpos))
        assert not made.success(world)
        world.put(body, where)
        mujoco.mj_forward(world.model, world.data)


def put(world: World, body: str, position: tuple[float, float, float], speed: float = 0.0) -> None:
    world.put(body, np.array([*position, 1, 0, 0, 0]))
    world.data.joint(body).qvel[2] = speed
    mujoco.mj_forward(world.model, world.data)


@pytest.mark.parametrize(
    ("offset", "speed", "expected"),
    [
        ((0.0, 0.0, 0.0), 0.0, True),
        ((0.01, 0.0, 0.0), 0.0, True),
        ((0.02, 0.0, 0.0), 0.0, False),
        ((0.0, 0.0, 0.01), 0.0, False),
        ((0.0, 0.0, 0.0), 0.2, False),
    ],
    ids=["on it", "a little beside", "over the edge", "above", "moving"],
)
def test_stack_is_a_cube_lying_on_the_other(offset: tuple[float, float, float], speed: float, expected: bool) -> None:
    world, made = begun("stack")
    carry(world, made, "cube")
    below = world.pose("base_cube")[:3]
    put(world, "cube", tuple(below + np.array([0, 0, 0.0275]) + offset), speed)
    assert made.success(world) is expected


@pytest.mark.parametrize(("away", "expected"), [(0.0, True), (0.015, True), (0.025, False)])
def test_push_is_a_block_on_the_mark(away: float, expected: bool) -> None:
    world, made = begun("push")
    x, y, _ = world.data.mocap_pos[0]
    put(world, "block", (x + away, y, 0.0175))
    assert made.success(world) is expected


def test_sort_is_every_cube_in_the_bin_of_its_colour() -> None:
    world, made = begun("sort", seed=1)
    carry(world, made, "cube1", "cube2", "cube3")
    out = np.empty(len(made.values))
    made.observe(world, out)
    bins = out[21:24].astype(int)
    assert set(bins) == {0, 1}, "this seed draws both colours"
    centres = out[24:].reshape(2, 3)
    for cube, number in enumerate(bins):
        put(world, f"cube{cube + 1}", (centres[number][0], centres[number][1] + 0.03 * (cube - 1), 0.017))
    assert made.success(world) is True
    wrong = centres[1 - bins[0]]
    put(world, "cube1", (wrong[0] + 0.03, wrong[1], 0.017))
    assert made.success(world) is False


@pytest.mark.parametrize(("opening", "speed", "expected"), [(0.09, 0, True), (0.07, 0, False), (0.09, 0.2, False)])
def test_drawer_is_open_and_at_rest(opening: float, speed: float, expected: bool) -> None:
    world, made = begun("drawer")
    number = int(world.model.body("cabinet").mocapid[0])
    where = world.data.mocap_pos[number].copy()
    world.data.mocap_pos[number] = world.data.site("gripperframe").xpos - [0.0, 0.0, 0.025]
    mujoco.mj_forward(world.model, world.data)
    assert not made.success(world), "the hand touches the drawer"
    world.data.mocap_pos[number] = where
    world.data.joint("drawer").qpos, world.data.joint("drawer").qvel = opening, speed
    mujoco.mj_forward(world.model, world.data)
    assert made.success(world) is expected
    out = np.empty(len(made.values))
    made.observe(world, out)
    np.testing.assert_allclose(out[:3], world.data.geom("drawer_handle").xpos, atol=1e-9)


def test_no_place_for_an_object_is_an_error() -> None:
    with pytest.raises(HardwareError, match=r"no place for the drawer .*: handle_distance \[0.05, 0.06\] and"):
        begun("drawer", handle_distance=(0.05, 0.06))


def test_resized_cube_equals_one_built_with_that_size() -> None:
    drawn, _ = begun("pick_cube", cube_size=(0.015, 0.035))
    size = 2 * float(drawn.model.geom("cube").size[0])
    built, _ = begun("pick_cube", cube_size=size)
    assert abs(size - 0.015) > 0.001, "it is the size that the model was built with"
    for name in (
        "geom_size",
        "geom_rbound",
        "geom_aabb",
        "body_mass",
        "body_inertia",
        "body_invweight0",
        "dof_invweight0",
    ):
        np.testing.assert_allclose(getattr(drawn.model, name), getattr(built.model, name), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "options"),
    [
        ("simulation.scene.light=0.7", {"light": 0.7}),
        ("simulation.scene.cube_size=[0.02, 0.03]", {"cube_size": (0.02, 0.03)}),
    ],
)
def test_option_of_a_scene_is_set_below_its_short_form(change: str, options: dict[str, Any]) -> None:
    changes = ["simulation.scene=pick_cube", change]
    config = load_config(find_config("so101_blind", installed_plugins()), overrides=changes)
    assert config.simulation is not None
    assert config.simulation.options.scene == scene("pick_cube", **options)


def test_scene_of_a_yaml_is_checked_with_its_options() -> None:
    with pytest.raises(ConfigError, match=r"simulation\.scene\.cube_sise: unknown key, did you mean 'cube_size'\?"):
        load_config(find_config("so101_pick_cube", installed_plugins()), overrides=["simulation.scene.cube_sise=0.02"])
