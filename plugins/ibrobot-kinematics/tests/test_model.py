"""Models from MJCF: forward kinematics and Jacobians against MuJoCo and finite differences; errors name the fault."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ibrobot_kinematics import KinematicModel, KinematicsError, read_mjcf, robot_model
from ibrobot_kinematics.rotations import log

from ibrobot_core.api import Description, Joint, Robot, Vector

from .arms import FIVE, SIX, by_mujoco, chains, load, write_arm

SHARED_FOLDER = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def within(model: KinematicModel, share: list[float]) -> Vector:
    return model.lower + np.resize(share, len(model.lower)) * (model.upper - model.lower)


shares = st.lists(st.floats(0, 1), min_size=12, max_size=12)


@SHARED_FOLDER
@given(chain=chains(), share=shares)
def test_forward_and_jacobian_agree_with_mujoco(tmp_path: Path, chain: tuple[str, tuple[str, ...]], share: list[float]):
    path, model = load(tmp_path, *chain)
    q = within(model, share)
    tip, jacobian = by_mujoco(path, model, q)
    np.testing.assert_allclose(model.forward(q).position, tip.position, atol=1e-9)
    np.testing.assert_allclose(model.forward(q).rotation, tip.rotation, atol=1e-9)
    np.testing.assert_allclose(model.jacobian(q), jacobian, atol=1e-9)


@SHARED_FOLDER
@given(chain=chains(), share=shares)
def test_jacobian_agrees_with_finite_differences(
    tmp_path: Path, chain: tuple[str, tuple[str, ...]], share: list[float]
):
    _, model = load(tmp_path, *chain)
    q, step = within(model, share), 1e-6
    jacobian = model.jacobian(q)
    for i in range(len(q)):
        offset = np.zeros(len(q))
        offset[i] = step
        before, after = model.forward(q - offset), model.forward(q + offset)
        difference = [after.position - before.position, log(after.rotation @ before.rotation.T)]
        np.testing.assert_allclose(jacobian[:, i], np.concatenate(difference) / (2 * step), atol=1e-6)


def test_joint_off_the_chain_does_not_move_the_tip(tmp_path: Path):
    model = read_mjcf(write_arm(tmp_path, *FIVE)).chain("tool", FIVE)
    q = np.zeros(6)
    assert not model.jacobian(q)[:, -1].any()
    np.testing.assert_array_equal(model.forward(q).position, model.forward(np.array([0, 0, 0, 0, 0, 1.0])).position)


def test_joints_that_are_not_listed_stay_at_zero(tmp_path: Path):
    path = write_arm(tmp_path, *SIX)
    whole, part = (read_mjcf(path).chain("tool", joints) for joints in (SIX, ("lift", "pan")))
    np.testing.assert_allclose(
        part.forward(np.array([0.4, 0.3])).position,
        whole.forward(np.array([0.3, 0.4, 0, 0, 0, 0, 0])).position,
        atol=1e-12,
    )


def test_limits_are_the_robots(tmp_path: Path):
    joints = tuple(Joint(name, -1.0, 1.2, max_velocity=3.0, max_acceleration=20.0) for name in FIVE)
    robot = Robot("arm", joints, description=Description(mjcf=write_arm(tmp_path, *FIVE), tip="tool"))
    model = robot_model(robot, ("elbow", "pan"))
    assert model.joint_names == ("elbow", "pan")
    np.testing.assert_array_equal([model.lower, model.upper], [[-1.0, -1.0], [1.2, 1.2]])


@pytest.mark.parametrize(
    ("tip", "joints", "message"),
    [
        ("nose", FIVE, "has no site 'nose'; it has: tool, on the cube"),
        ("tool", ("pan", "tail"), "has no joint 'tail'; it has: pan, lift"),
        ("tool", ("cube",), "joint 'cube' is neither a hinge nor a slide"),
        ("on the cube", FIVE, "the tip moves with 'cube', a free or ball joint"),
    ],
)
def test_request_that_does_not_fit_the_file_is_refused(tmp_path: Path, tip: str, joints: tuple[str, ...], message: str):
    path = write_arm(tmp_path, *FIVE)
    with pytest.raises(KinematicsError, match=f"{path}.*{message}"):
        read_mjcf(path).chain(tip, joints)


def test_joint_without_limits_is_refused(tmp_path: Path):
    path = write_arm(tmp_path, *FIVE)
    path.write_text(path.read_text().replace('range="-1.6 1.6" limited="true"', "", 1))
    with pytest.raises(KinematicsError, match="joint 'pan' has no limits"):
        read_mjcf(path).chain("tool", FIVE)


FAULTS = {
    "no XML": ("<mujoco", r"arm\.xml:1: not valid XML"),
    "no site": ("<mujoco><worldbody><body><geom/></body></worldbody></mujoco>", r"arm\.xml has no site 'tool'"),
    "unknown attribute": (
        "<mujoco>\n<worldbody>\n<geom color='1'/></worldbody></mujoco>",
        r"arm\.xml:3: MuJoCo cannot load it: .*unrecognized attribute: 'color'",
    ),
    "no XML in an included file": ("<mujoco>\n<include file='base.xml'/></mujoco>", r"base\.xml:2: not valid XML"),
    "no included file": ("<mujoco>\n<include file='gone.xml'/></mujoco>", r"gone\.xml: cannot be read: No such file"),
    "unknown class": (
        "<mujoco>\n<worldbody><body>\n<joint name='a' class='b'/></body></worldbody></mujoco>",
        r"arm\.xml:3: joint 'a': no default class 'b'",
    ),
}


@pytest.mark.parametrize(("text", "message"), FAULTS.values(), ids=FAULTS)
def test_file_that_cannot_be_loaded_is_named_with_its_line(tmp_path: Path, text: str, message: str):
    path = tmp_path / "arm.xml"
    path.write_text(text)
    (tmp_path / "base.xml").write_text("<mujocoinclude>\n<worldbody></mujocoinclude>")
    with pytest.raises(KinematicsError, match=message):
        read_mjcf(path).chain("tool", ())


def test_an_unusable_mesh_is_named(tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(
        "<mujoco><asset><mesh name='m' file='gone.stl'/></asset>"
        "<worldbody><body><geom type='mesh' mesh='m'/></body></worldbody></mujoco>"
    )
    with pytest.raises(KinematicsError, match=r"arm\.xml: MuJoCo cannot load it: .*gone\.stl"):
        assert read_mjcf(path).solid


def test_a_file_is_read_once_until_it_or_an_included_one_changes(tmp_path: Path):
    path, arm = tmp_path / "whole.xml", write_arm(tmp_path, *FIVE)
    path.write_text(f'<mujoco><include file="{arm.name}"/></mujoco>')
    first = read_mjcf(path)
    assert read_mjcf(path) is first
    write_arm(tmp_path, *SIX)
    second = read_mjcf(path)
    assert second is not first
    assert second.chain("tool", SIX).joint_names == SIX
    path.write_text("<mujoco/>")
    assert read_mjcf(path).spec.worldbody.first_body() is None


def test_robot_without_an_mjcf_is_refused():
    robot = Robot("arm", (Joint("pan", -1.0, 1.0, max_velocity=3.0, max_acceleration=20.0),))
    with pytest.raises(KinematicsError, match=r"robot 'arm' has no robot\.description\.mjcf"):
        robot_model(robot)


def two_arms(path: Path) -> Robot:
    names = [f"{arm}_{name}" for arm in ("left", "right") for name in FIVE]
    joints = tuple(Joint(name, -1.5, 1.5, max_velocity=1.0, max_acceleration=1.0) for name in names)
    arms = {"left_": (0.0, 0.2, 0.0, 0.0), "right_": (0.0, -0.2, 0.0, 0.0)}
    groups = {arm: tuple(f"{arm}_{name}" for name in FIVE) for arm in ("left", "right")}
    return Robot("two", joints, groups=groups, description=Description(mjcf=path, tip="tool", arms=arms))


def test_each_of_several_arms_has_the_model_in_the_frame_of_its_base(tmp_path: Path):
    robot = two_arms(write_arm(tmp_path, *FIVE))
    alone = read_mjcf(robot.description.mjcf or Path()).chain("tool", FIVE)
    q = np.array([0.3, -0.6, 1.1, 0.2, 0.2, 0.4])[: len(FIVE)]
    for arm in ("left", "right"):
        model = robot_model(robot.part(arm))
        assert model.joint_names == robot.groups[arm]
        np.testing.assert_array_equal(model.forward(q).position, alone.forward(q).position)


def test_several_arms_have_no_common_tool(tmp_path: Path):
    with pytest.raises(KinematicsError, match=r"robot 'two' has several arms \('left_', 'right_'\), each with a tool"):
        robot_model(two_arms(write_arm(tmp_path, *FIVE)))
