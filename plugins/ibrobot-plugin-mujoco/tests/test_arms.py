"""Two SO-101 in one scene, from the model of one: names, places, motion, cameras."""

from __future__ import annotations

import math

import attrs
import mujoco
import numpy as np
import pytest
from ibrobot_kinematics import robot_model
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.model import build_model
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import control_context

from ibrobot_core.api import Robot, SteppedClock

PLACES = {"left_": (0.0, 0.2, 0.0, 0.0), "right_": (0.05, -0.2, 0.01, -math.pi / 2)}
OPTIONS = MujocoOptions(scene=scene("pick_cube", cube_distance=(0.22, 0.3), bin_position=(0.12, 0.0)))
PERIOD_NS = 10_000_000


def two_arms() -> Robot:
    """Two robots as `so101()` side by side."""
    one = so101()
    joints = tuple(attrs.evolve(joint, name=prefix + joint.name) for prefix in PLACES for joint in one.joints)
    poses = {name: pose * 2 for name, pose in one.description.poses.items()}
    groups = {prefix[:-1]: tuple(prefix + name for name in one.joint_names) for prefix in PLACES}
    description = attrs.evolve(one.description, poses=poses, arms=PLACES)
    return attrs.evolve(one, joints=joints, groups=groups, description=description)


@pytest.mark.parametrize("visual", [False, True])
def test_every_arm_has_the_model_of_one(visual: bool) -> None:
    alone = build_model(MujocoOptions(scene=scene("empty")), so101(), visual=visual)
    model = build_model(attrs.evolve(OPTIONS, scene=scene("empty")), two_arms(), visual=visual)
    assert model.nq == 2 * alone.nq
    for prefix in PLACES:
        for name in so101().joint_names:
            np.testing.assert_array_equal(model.joint(prefix + name).range, alone.joint(name).range)
        np.testing.assert_array_equal(model.actuator_gainprm[: alone.nu], alone.actuator_gainprm)
        assert model.camera(f"{prefix}wrist_cam").id >= 0
    assert (model.ngeom - 1) == 2 * (alone.ngeom - 1), "the table is there once"
    assert (model.opt.timestep, model.opt.integrator) == (alone.opt.timestep, alone.opt.integrator)


def test_bases_stand_where_the_description_says() -> None:
    model = build_model(OPTIONS, two_arms(), visual=False)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    one = build_model(OPTIONS, so101(), visual=False)
    alone = mujoco.MjData(one)
    mujoco.mj_forward(one, alone)
    tip = alone.site("gripperframe").xpos
    np.testing.assert_allclose(data.site("left_gripperframe").xpos, np.add(tip, (0, 0.2, 0)), atol=1e-9)
    turned = [tip[1] + 0.05, -tip[0] - 0.2, tip[2] + 0.01]
    np.testing.assert_allclose(data.site("right_gripperframe").xpos, turned, atol=1e-9)


def test_each_arm_follows_its_commands_and_leaves_the_other_alone() -> None:
    robot, clock = two_arms(), SteppedClock(0)
    hardware = MujocoHardware(OPTIONS, control_context(robot=robot, clock=clock, period_ns=PERIOD_NS))
    hardware.connect()
    rest = robot.pose("rest")
    goal = rest.copy()
    goal[robot.indices(robot.groups["left"])] = so101().pose("home")
    for _ in range(200):
        hardware.write(goal)
        hardware.advance(PERIOD_NS)
        clock.advance(PERIOD_NS)
    position = hardware.read().position
    hardware.disconnect()
    np.testing.assert_allclose(position, goal, atol=0.1)


def test_the_tool_of_an_arm_is_where_its_kinematics_say() -> None:
    robot = two_arms()
    model = build_model(OPTIONS, robot, visual=False)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    q = robot.lower + rng.random(12) * (robot.upper - robot.lower)
    for name, at in zip(robot.joint_names, q, strict=True):
        data.joint(name).qpos[0] = at
    mujoco.mj_forward(model, data)
    part = robot.part("left")
    tip = robot_model(part).forward(q[robot.indices(part.joint_names)])
    np.testing.assert_allclose(data.site("left_gripperframe").xpos, np.add(tip.position, (0, 0.2, 0)), atol=1e-9)
