"""The URDF's transforms against MuJoCo's kinematics of the MJCF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ibrobot_description.frames import transform
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.config import load_config
from ibrobot_core.messages import Quaternion, Vector3

pytestmark = pytest.mark.integration

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
BODIES = {"shoulder_link": "shoulder", "lower_arm_link": "lower_arm", "gripper_link": "gripper"}


def matrix(translation: Vector3, rotation: Quaternion) -> np.ndarray:
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    result = np.eye(4)
    result[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    result[:3, 3] = translation.x, translation.y, translation.z
    return result


def test_links_stand_where_mujoco_has_them() -> None:
    import mujoco

    robot = load_config(CONFIG, sim=True).robot
    assert robot.description.urdf is not None
    position = np.array([0.3, -0.5, 0.7, 0.2, 0.9, 0.4])
    joints = read_urdf(robot.description.urdf).joints
    at = dict(zip(robot.joint_names, position, strict=True))
    poses = {"base_link": np.eye(4)}
    while len(poses) <= len(joints):
        for joint in joints:
            if joint.parent in poses and joint.child not in poses:
                found = transform(joint, float(at.get(joint.name, 0.0)), 0)
                poses[joint.child] = poses[joint.parent] @ matrix(found.translation, found.rotation)
    model = mujoco.MjModel.from_xml_path(str(robot.description.mjcf))
    physics = mujoco.MjData(model)
    physics.qpos[:] = position
    mujoco.mj_kinematics(model, physics)
    for link_name, body in BODIES.items():
        np.testing.assert_allclose(poses[link_name][:3, 3], physics.body(body).xpos, atol=2e-4)
