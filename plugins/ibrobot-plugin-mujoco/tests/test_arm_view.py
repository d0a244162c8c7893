"""Where cameras see the arm."""

from __future__ import annotations

from contextlib import closing

import attrs
import numpy as np
import pytest
from ibrobot_mujoco.arm_view import ArmView

from ibrobot_core.api import CameraInfo, Header, NotSupported
from ibrobot_core.app import Mount, find_config, installed_plugins, load_config

MISSING = installed_plugins().missing("sensor", "mujoco")
pytestmark = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))

SIZE = (240, 320)
REST, HOME = np.array([0, -1.57, 1.57, 0.79, 0, 0]), np.zeros(6)


@pytest.fixture(scope="module")
def config():
    return load_config(find_config("so101", installed_plugins()), sim=True)


def info(focal=312.5):
    k = np.array([focal, 0, 159.5, 0, focal, 119.5, 0, 0, 1.0])
    return CameraInfo(Header(0), 240, 320, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), np.zeros(12))


def real(config, mount):
    """The same robot with a real camera somewhere."""
    top = attrs.evolve(config.peripherals["top"], transform=mount)
    return attrs.evolve(config, simulation=None, peripherals={"top": top})


def test_arm_moves_against_a_camera_that_stands(config):
    with closing(ArmView(config, "top", None, SIZE)) as view:
        assert view.stands
        turned = view.moving(REST), view.moving(REST + np.array([0.6, 0, 0, 0, 0, 0]))
    for mask in turned:
        assert mask.shape == SIZE
        assert 0.02 < mask.mean() < 0.3
    both = (turned[0] & turned[1]).sum() / turned[0].sum()
    assert 0.05 < both < 0.7, "the arm has turned about its base"


def test_all_but_its_own_link_moves_against_a_camera_on_the_arm(config):
    with closing(ArmView(config, "wrist", None, SIZE)) as view:
        assert not view.stands
        masks = [view.moving(pose) for pose in (REST, HOME)]
    np.testing.assert_array_equal(masks[0], masks[1])
    assert 0.5 < masks[0].mean() < 1.0


def test_calibrated_camera_sees_what_the_one_of_the_scene_sees(config):
    """The camera `top` of each scene stands 0.8 m above the table, and looks down."""
    mount = Mount(parent="world", xyz=(0.16, 0.04, 0.80), rpy=(0.0, float(np.pi / 2), 0.0))
    with closing(ArmView(config, "top", None, SIZE)) as view:
        simulated = view.moving(REST)
    with closing(ArmView(real(config, mount), "top", info(), SIZE)) as view:
        assert view.stands
        assert (view.moving(REST) ^ simulated).mean() < 0.004


@pytest.mark.parametrize(
    ("mount", "said", "says"),
    [
        (None, info(), "unknown where camera top is"),
        (Mount(parent="world"), None, "is not calibrated"),
        (Mount(parent="world"), info(0.0), "is not calibrated"),
        (Mount(parent="shelf"), info(), "its parent shelf is neither a link nor a body of the MJCF"),
    ],
)
def test_what_is_missing_is_named(config, mount, said, says):
    with pytest.raises(NotSupported, match=says):
        ArmView(real(config, mount), "top", said, SIZE)


def test_robot_without_a_model_is_named(config):
    robot = attrs.evolve(config.robot, description=attrs.evolve(config.robot.description, mjcf=None))
    with pytest.raises(NotSupported, match=r"set robot\.description\.mjcf"):
        ArmView(attrs.evolve(real(config, Mount(parent="world")), robot=robot), "top", info(), SIZE)


@pytest.mark.parametrize("parent", ["world", "gripper", "moving_jaw_so101_v1_link"])
@pytest.mark.parametrize("joint", ["shoulder_pan", "gripper"])
def test_joint_that_the_mjcf_lacks_is_named(config, parent, joint):
    joints = tuple(attrs.evolve(each, name="hip") if each.name == joint else each for each in config.robot.joints)
    robot = attrs.evolve(config.robot, joints=joints)
    with pytest.raises(NotSupported, match=r"has no joint 'hip'; it has: shoulder_pan, "):
        ArmView(attrs.evolve(real(config, Mount(parent=parent)), robot=robot), "top", info(), SIZE)
