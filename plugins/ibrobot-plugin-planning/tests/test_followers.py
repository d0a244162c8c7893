"""Joints that follow others, as the second finger of a gripper does: planners and the guard know where they are."""

from __future__ import annotations

import logging
from pathlib import Path

import mujoco
import numpy as np
import pytest
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.clearance_guard import ClearanceGuard
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.world.arm import ADJACENT, Arm, read_arm
from ibrobot_planning.world.collision import Collisions, unchecked_pairs
from ibrobot_planning.world.objects import World

from ibrobot_core.api import Context, Description, Joint, Robot, SteppedClock, Vector
from ibrobot_core.control.safety import SafetyLayer

from .table_arm import box

RAIL, SWING, JAW = range(3)
JOINTS = ("rail", "swing", "jaw")
LIMITS = ((0.9, 1.3), (-2.0, 2.0), (-0.1, 1.2))
MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="base"><geom size=".03"/>
<body name="cart" pos="0 0 .1"><joint name="rail" type="slide" axis="1 0 0" ref="1" range=".9 1.3"/>
<geom type="box" size=".02 .02 .02"/>
<body name="beam" pos="0 0 .05"><joint name="swing" axis="0 1 0" range="-2 2"/>
<geom type="capsule" fromto="0 0 .03 0 0 .2" size=".01"/>
<body name="finger" pos=".02 0 .22"><joint name="jaw" axis="0 1 0" ref=".1" range="-.1 1.2"/>
<geom type="capsule" fromto="0 0 .01 0 0 .08" size=".006"/></body>
<body name="thumb" pos="-.02 0 .22"><joint name="squeeze" axis="0 1 0" ref="-.2"/>
<geom type="capsule" fromto="0 0 .01 0 0 .08" size=".006"/>
<body name="nail" pos="0 0 .09"><joint name="bend" type="slide" axis="0 0 1"/><geom size=".006"/></body></body>
<body name="flap" pos="0 .03 .1"><joint name="tilt" axis="1 0 0" range="-1 1"/><geom size=".01"/></body>
</body></body></body></worldbody>
<equality><joint joint1="bend" joint2="squeeze" polycoef=".004 -.02 0 0 0"/>
<joint joint1="squeeze" joint2="jaw" polycoef=".05 -1.5 0 0 0"/>
<joint joint1="tilt" joint2="swing" polycoef="0 0 .3 0 0"/></equality></mujoco>"""


def write(folder: Path) -> Path:
    path = folder / "arm.xml"
    path.write_text(MJCF)
    return path


@pytest.fixture
def arm(tmp_path) -> Arm:
    return read_arm(write(tmp_path), JOINTS)


def make_robot(folder: Path) -> Robot:
    joints = [
        Joint(name, *limits, max_velocity=2.0, max_acceleration=10.0)
        for name, limits in zip(JOINTS, LIMITS, strict=True)
    ]
    description = Description(mjcf=write(folder), tip="none")
    return Robot(name="rail", joints=tuple(joints), groups={"arm": JOINTS}, description=description)


def random_configurations(count: int) -> Vector:
    low, high = np.array(LIMITS).T
    return np.random.default_rng(0).uniform(low, high, (count, len(JOINTS)))


def test_links_are_where_mujoco_has_them(arm) -> None:
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    for rail, swing, jaw in random_configurations(20):
        squeeze = 0.05 - 1.5 * (jaw - 0.1)
        positions = {"rail": rail, "swing": swing, "jaw": jaw, "squeeze": squeeze - 0.2, "bend": 0.004 - 0.02 * squeeze}
        for name, position in positions.items():
            data.joint(name).qpos = position
        mujoco.mj_kinematics(model, data)
        for link in ("cart", "beam", "finger", "thumb", "nail"):
            pose = arm.link_pose(link, np.array([rail, swing, jaw]))
            np.testing.assert_allclose(pose[:3, 3], data.body(link).xpos, atol=1e-9)
            np.testing.assert_allclose(pose[:3, :3].ravel(), data.body(link).xmat, atol=1e-9)


def test_no_point_moves_farther_than_its_reach(arm) -> None:
    """Nor than its lever, relative to what does not move: along a slide, and with all that follows."""
    reach = Collisions(arm, World(), JOINTS).reach
    links = ("cart", "beam", "finger", "thumb", "nail")
    farthest = np.zeros(len(JOINTS))
    for q in random_configurations(200):
        for joint in range(len(JOINTS)):
            step = 1e-4 * np.eye(len(JOINTS))[joint]
            moved = [arm.link_pose(link, q + step)[:3, 3] - arm.link_pose(link, q - step)[:3, 3] for link in links]
            farthest[joint] = max(farthest[joint], *(np.linalg.norm(each) / 2e-4 for each in moved))
    assert (farthest <= reach + 1e-9).all()
    assert reach[JAW] > 1.5 * 0.09, "the nail turns with the thumb"
    assert arm.travel.max() == pytest.approx(0.3), "of the rail, from its reference on"


def test_fingers_of_one_joint_may_close_on_one_another_and_others_are_checked(arm) -> None:
    assert unchecked_pairs(arm)["finger", "thumb"] == ADJACENT
    assert ("finger", "nail") not in unchecked_pairs(arm, samples=2)


def test_a_path_sees_what_follows(arm) -> None:
    opened, closed = np.array([1.0, 0.0, 1.2]), np.array([1.0, 0.0, 0.1])
    thumb = arm.link_pose("thumb", opened) @ [0.0, 0.0, 0.06, 1.0]
    checks = Collisions(arm, World({"post": box(*thumb[:3], 0.02, 0.02, 0.02)}), JOINTS)
    assert checks.free(closed)
    assert [{each.first, each.second} for each in checks.contacts(opened)] == [{"thumb", "post"}]
    assert not checks.line_free(closed, opened, 0.002)
    assert checks.line_free(closed, np.array([1.0, 0.0, 0.3]), 0.002)


def test_the_guard_keeps_what_follows_off_objects(tmp_path, caplog) -> None:
    robot = make_robot(tmp_path)
    guard = ClearanceGuard(
        ClearanceGuardOptions(), Context("guard", SteppedClock(7), logging.getLogger("test"), robot, JOINTS)
    )
    assert "joints of the model that the robot lacks at their reference position: tilt" in caplog.text
    opened, closed = np.array([1.0, 0.0, 1.2]), np.array([1.0, 0.0, 0.1])
    thumb = guard._arm.link_pose("thumb", opened) @ [0.0, 0.0, 0.06, 1.0]
    post = box(*thumb[:3], 0.02, 0.02, 0.02)
    guard.world(WorldChange({"post": post}).message())
    checks = Collisions(guard._arm, World({"post": post}), JOINTS, padding=0.0021)
    safety = SafetyLayer(robot, 10_000_000, guard)
    safety.activate(closed)
    at = closed
    for _ in range(150):
        at = safety.apply(opened, at)
        assert checks.free(at)
    assert 0.5 < at[JAW] < 1.0
    for _ in range(100):
        at = safety.apply(np.array([1.1, 0.0, 0.1]), at)
    np.testing.assert_allclose(at, [1.1, 0.0, 0.1], atol=1e-6)
