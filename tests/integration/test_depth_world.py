"""The simulated depth camera sees the cube: the planner avoids its cells, and the arm is not among them."""

from __future__ import annotations

import numpy as np
import pytest
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import SNAPSHOT, Voxels, World

from ibrobot_core.api import Float64MultiArray
from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif((missing := installed_plugins().missing("sensor", "mujoco")) is not None, reason=str(missing)),
]

CAMERA = (
    "peripherals=[{name: depth, kind: camera, type: mujoco, camera: top, stream: depth, width: 320, height: 240, "
    "transform: {parent: base_link, xyz: [0.16, 0.04, 0.8], rpy: [0, 1.5707963, 0]}}]"
)


def test_cells_of_the_depth_camera_are_obstacles():
    registry = installed_plugins()
    config = load_config(
        find_config("so101_blind", registry),
        sim=True,
        mode="moveit_planning",
        registry=registry,
        overrides=(
            CAMERA,
            "simulation.start_pose=home",
            "control_modes.moveit_planning.planner={type: rrt_connect}",
            "world={clouds: {depth: {topic: /camera/depth/image_raw, cell: 0.01, margin: 0.03, reach: 0.6}}, objects: "
            "{table: {shape: box, size: [2, 2, 0.02], position: [0, 0, -0.011]}, "
            "bin: {shape: box, size: [0.3, 0.3, 0.2], position: [0.1, 0.24, 0.1]}}}",
        ),
    )
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=3)))
    try:
        runtime.start()
        session = runtime.session
        scene = session.bus.subscribe("/simulation/scene", 1)
        for _ in range(20):
            runtime.step()
        world = session.bus.call(SNAPSHOT, None)
        assert isinstance(world, World)
        cells = world.objects["depth"].shape
        assert isinstance(cells, Voxels)
        received = scene.get()
        assert received is not None
        assert isinstance(received.message, Float64MultiArray)
        cube = received.message.data[:3]
        centres = cells.centres
        np.testing.assert_allclose(centres.mean(axis=0)[:2], cube[:2], atol=0.01)
        assert np.ptp(centres, axis=0).max() < 0.06, "nothing but the cube"
        # The arm itself is free of its own cells.
        arm = robot_arm(config.robot)
        checks = Collisions(arm, World({"depth": world.objects["depth"]}), config.robot.joint_names)
        assert not [
            each for each in checks.contacts(session.measured().position) if "depth" in (each.first, each.second)
        ]
        x, y, z = cube.tolist()
        number = session.bus.call("/planning/go_to", f"xyz={x},{y},{z}")
        for _ in range(50):
            runtime.step()
        result = session.bus.call("/planning/result", number)
        assert result is not None
        assert result.code.name == "GOAL_IN_COLLISION"
        assert "depth" in result.message
    finally:
        runtime.stop()
