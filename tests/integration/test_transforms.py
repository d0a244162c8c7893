"""The description in a run: the URDF's transforms against MuJoCo's kinematics, and what a recording has of it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml
from ibrobot_kinematics.frames import transform
from ibrobot_kinematics.poses import matrix
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.config import load_config
from ibrobot_core.messages import Pose

pytestmark = pytest.mark.integration

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
BODIES = {"shoulder_link": "shoulder", "lower_arm_link": "lower_arm", "gripper_link": "gripper"}


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
                poses[joint.child] = poses[joint.parent] @ matrix(Pose(found.translation, found.rotation))
    model = mujoco.MjModel.from_xml_path(str(robot.description.mjcf))
    physics = mujoco.MjData(model)
    physics.qpos[:] = position
    mujoco.mj_kinematics(model, physics)
    for link_name, body in BODIES.items():
        np.testing.assert_allclose(poses[link_name][:3, 3], physics.body(body).xpos, atol=2e-4)


def test_recording_offers_the_description_to_late_subscribers(tmp_path: Path, ibrobot: tuple[str, ...]) -> None:
    command = [*ibrobot, "record", "so101_blind", "--sim", "--lockstep", "--headless", "--episodes", "1"]
    options = ["--set", "contract.max_duration_s=0.2", "--set", "recording.topics=all"]
    subprocess.run([*command, *options], cwd=tmp_path, capture_output=True, timeout=120, check=False)
    (metadata,) = tmp_path.glob("**/metadata.yaml")
    topics = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]["topics_with_message_count"]
    offered = {topic["topic_metadata"]["name"]: (topic["topic_metadata"], topic["message_count"]) for topic in topics}
    for name, latched in (("/robot_description", True), ("/tf_static", True), ("/tf", False)):
        found, count = offered[name]
        assert ("transient_local" in str(found["offered_qos_profiles"])) == latched
        assert (count == 1) == latched
