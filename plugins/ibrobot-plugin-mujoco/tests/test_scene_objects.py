"""Objects around the robot: those added to the scene, and all of them as shapes for planners."""

from __future__ import annotations

from typing import override

import numpy as np
import pytest
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scene_objects import scene_objects
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import SimulatedHardwareSuite, control_context

from ibrobot_core.api import Context, EpisodeSetup, Hardware, HardwareError, SceneObject, Vector
from ibrobot_core.app import ConfigError, single_options

ROBOT = so101()
OBJECTS = """objects:
  post: {shape: box, size: [0.02, 0.04, 0.1], position: [0.2, -0.2, 0.05], yaw: 0.5}
  can: {shape: cylinder, radius: 0.02, height: 0.1, position: [0.25, 0.15, 0.05], mass: 0.1}
  ball: {shape: sphere, radius: 0.02, position: [0.1, -0.25, 0.3], mass: 0.05}
"""


def options(text: str = OBJECTS) -> MujocoOptions:
    return single_options(MujocoOptions, (), "simulation", text=text)


class TestConformanceWithObjects(SimulatedHardwareSuite):
    reach = 0.3  # farther, the shoulder alone meets the table

    @override
    def context(self) -> Context:
        return control_context(robot=ROBOT)

    @override
    def make(self, ctx: Context) -> MujocoHardware:
        return MujocoHardware(options(), ctx)

    @override
    @staticmethod
    def _signals(hardware: Hardware) -> list[Vector]:
        values = SimulatedHardwareSuite._signals(hardware)
        values[0][:2] = 0  # the stamp, which goes on from run to run
        return values


def test_planners_get_every_object_of_the_scene():
    found = {thing.name: thing for thing in options().scene_objects(ROBOT)}
    parts = {"bin_floor", "bin_left", "bin_right", "bin_front", "bin_back"}
    assert set(found) == {"table", "cube", *parts, "post", "can", "ball"}
    assert (found["table"].shape, found["table"].size) == ("plane", ())
    assert (found["cube"].shape, found["cube"].size) == ("box", (0.025, 0.025, 0.025))
    assert (found["can"].shape, found["can"].size) == ("cylinder", (0.02, 0.1))
    assert (found["ball"].shape, found["ball"].size) == ("sphere", (0.02,))
    post = found["post"].pose
    assert (post.position.x, post.position.y, post.position.z) == pytest.approx((0.2, -0.2, 0.05))
    assert (post.orientation.z, post.orientation.w) == pytest.approx((np.sin(0.25), np.cos(0.25)))
    still = {name for name, thing in found.items() if not thing.topic}
    assert still == {"table", *parts, "post"}, "they have no mass"


def pose_of(thing: SceneObject) -> list[float]:
    p, q = thing.pose.position, thing.pose.orientation
    return [p.x, p.y, p.z, q.w, q.x, q.y, q.z]


def test_signals_have_the_poses_of_objects_that_move():
    hardware = MujocoHardware(options(), control_context(robot=ROBOT))
    hardware.connect()
    hardware.reset(EpisodeSetup(3))
    found = {thing.name: thing for thing in scene_objects(options(), ROBOT)}

    def read(name: str) -> Vector:
        number = [signal.topic for signal in hardware.signals].index(found[name].topic)
        out = np.zeros(hardware.signals[number].size)
        hardware.read_signal(number, out)
        return out[found[name].first : found[name].first + 7]

    for name in ("can", "ball"):
        np.testing.assert_allclose(read(name), pose_of(found[name]), atol=1e-12)
    assert read("cube")[2] == 0.0125
    for _ in range(10):
        hardware.advance(10_000_000)
    assert read("ball")[2] < 0.27, "it falls"
    np.testing.assert_allclose(read("can"), pose_of(found["can"]), atol=1e-3)
    hardware.disconnect()
    assert all(len(thing.color) == 4 for thing in found.values()), "as a camera sees them"
    assert len({thing.color for thing in found.values()}) > 1


def test_cube_begins_clear_of_objects():
    can = "shape: cylinder, radius: 0.02, height: 0.1"
    ring = ", ".join(
        f"p{i}: {{{can}, position: [{0.235 * np.cos(bearing)}, {0.235 * np.sin(bearing)}, 0.05]}}"
        for i, bearing in enumerate((-0.55, -0.2, 0.3))
    )
    given = options(f"objects: {{{ring}}}")
    hardware = MujocoHardware(given, control_context(robot=ROBOT))
    hardware.connect()
    places = [np.array(pose_of(thing)[:2]) for thing in scene_objects(given, ROBOT) if thing.name.startswith("p")]
    for seed in range(10):
        hardware.reset(EpisodeSetup(seed))
        out = np.zeros(10)
        hardware.read_signal(1, out)
        assert min(np.linalg.norm(out[:2] - place) for place in places) > 0.05
    hardware.disconnect()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{shape: box, position: [0, 0, 0]}", "a box takes size; size is missing"),
        ("{shape: sphere, size: [1, 1, 1], position: [0, 0, 0]}", "a sphere takes radius; size is given"),
        (
            "{shape: cylinder, radius: 0.1, position: [0, 0, 0]}",
            "a cylinder takes radius and height; height is missing",
        ),
        (
            "{shape: box, size: [0.1, 0, 0.1], position: [0, 0, 0]}",
            "size is [0.1, 0.0, 0.1], must be three lengths above 0",
        ),
        ("{shape: sphere, radius: 0.1, position: [0, 0, 0], mass: 0}", "0.0 is too small, must be above 0 kg"),
        ("{shape: cone, position: [0, 0, 0]}", "'cone' is not one of: box, sphere, cylinder"),
    ],
)
def test_malformed_objects_are_refused(text: str, message: str):
    with pytest.raises(ConfigError) as failure:
        options(f"objects: {{thing: {text}}}")
    assert "objects.thing" in str(failure.value)
    assert message in str(failure.value)


def test_object_needs_a_name_of_its_own():
    text = "objects: {cube: {shape: sphere, radius: 0.1, position: [0.5, 0, 0.1]}}"
    with pytest.raises(HardwareError, match=r"simulation.objects: the scene has 'cube' already"):
        scene_objects(options(text), ROBOT)
