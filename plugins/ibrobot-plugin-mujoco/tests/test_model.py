"""The scene: servo values, equal layouts of physics and visual model, low-poly meshes, what a foreign MJCF lacks."""

from __future__ import annotations

from pathlib import Path

import attrs
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ibrobot_kinematics.meshes import cluster
from ibrobot_mujoco.lowpoly import read_stl
from ibrobot_mujoco.model import build_model, build_world
from ibrobot_mujoco.options import MujocoOptions, SceneCamera
from ibrobot_mujoco.scenes import SCENES, scene
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import DrawnWorld, physics_size, stamp_of, write_physics

from ibrobot_core.api import Description, HardwareError, Joint, Robot, SensorError

ROBOT = so101()
STAMP_NS = 1_700_000_000_123_456_789


def other_robot(tmp_path: Path, actuators: str) -> Robot:
    """A robot of one joint, `slide`, with an MJCF of its own."""
    path = tmp_path / "other.xml"
    path.write_text(f"""<mujoco><worldbody><body><joint name="slide" type="slide"/><geom size="0.1"/></body></worldbody>
        <actuator>{actuators}</actuator></mujoco>""")
    joint = Joint("slide", -1.0, 1.0, max_velocity=1.0, max_acceleration=1.0)
    return Robot("other", (joint,), description=Description(mjcf=path))


@pytest.mark.parametrize("name", [name for name in SCENES if name != "handover"])
def test_visual_and_physics_model_have_one_layout(name: str) -> None:
    options = MujocoOptions(scene=scene(name))
    physics, visual = (build_model(options, ROBOT, visual=v) for v in (False, True))
    assert (physics.nq, physics.nv) == (visual.nq, visual.nv)
    names = [physics.joint(i).name for i in range(physics.njnt)]
    assert names == [visual.joint(i).name for i in range(visual.njnt)]
    np.testing.assert_array_equal(physics.jnt_qposadr, visual.jnt_qposadr)
    np.testing.assert_array_equal(physics.jnt_dofadr, visual.jnt_dofadr)


def test_state_travels_from_physics_to_picture() -> None:
    options = MujocoOptions(
        scene=scene("stack", cube_size=(0.02, 0.03), cube_colour=(0, 1), light=0.5, camera_turn=0.1)
    )
    world, made = build_world(options, ROBOT, visual=False)
    drawn = DrawnWorld.of(options, ROBOT)
    factors = made.begin(world, np.random.default_rng(3))
    world.data.ctrl[:] = 0.3
    mujoco.mj_step(world.model, world.data, 200)
    vector = np.full(physics_size(world, made), np.nan)
    write_physics(world, factors, STAMP_NS, vector)
    drawn.follow(vector)
    mujoco.mj_kinematics(world.model, world.data)
    assert stamp_of(vector) == STAMP_NS
    assert abs(world.data.body("gripper").xpos - world.model.body("gripper").pos).max() > 0.01
    for body in ("gripper", "moving_jaw_so101_v1", "cube", "base_cube"):
        np.testing.assert_array_equal(drawn.data.body(body).xpos, world.data.body(body).xpos)
        np.testing.assert_array_equal(drawn.data.body(body).xquat, world.data.body(body).xquat)
    for name in ("cube", "base_cube"):
        np.testing.assert_array_equal(drawn.model.geom(name).size, world.model.geom(name).size)
        np.testing.assert_array_equal(drawn.model.geom(name).rgba, world.model.geom(name).rgba)
    plain = build_model(MujocoOptions(scene=scene("stack")), ROBOT, visual=True)
    np.testing.assert_allclose(drawn.model.light_diffuse, 0.5 * plain.light_diffuse)
    assert abs(drawn.model.camera("top").quat - plain.camera("top").quat).max() > 0.01
    assert not np.array_equal(drawn.model.geom("cube").size, plain.geom("cube").size)


def test_state_of_another_scene_is_refused() -> None:
    empty = DrawnWorld.of(MujocoOptions(scene=scene("empty")), ROBOT)
    with pytest.raises(SensorError, match=r"/simulation/physics has 15 values, but this scene has 17"):
        empty.follow(np.zeros(15))


def test_physics_model_weighs_what_the_mjcf_says() -> None:
    whole = mujoco.MjModel.from_xml_path(str(ROBOT.description.mjcf))
    stripped = build_model(MujocoOptions(scene=scene("empty")), ROBOT, visual=False)
    np.testing.assert_array_equal(stripped.body_mass, whole.body_mass)
    np.testing.assert_array_equal(stripped.body_inertia, whole.body_inertia)
    assert stripped.nmeshface < whole.nmeshface / 10


def test_servos_are_the_mjcfs_unless_overridden() -> None:
    stock = build_model(MujocoOptions(), ROBOT, visual=False)
    np.testing.assert_array_equal(stock.actuator_gainprm[:, 0], 998.22)
    np.testing.assert_array_equal(stock.actuator_biasprm[:, 2], -2.731)
    np.testing.assert_array_equal(stock.actuator_forcerange[:, 1], 2.94)
    options = MujocoOptions(kp=50.0, kv=1.0, damping=0.1, frictionloss=0.2, armature=0.03, torque_limit=1.5)
    tuned = build_model(options, ROBOT, visual=False)
    np.testing.assert_array_equal(tuned.actuator_gainprm[:, 0], 50.0)
    np.testing.assert_array_equal(tuned.actuator_biasprm[:, 1:3], [[-50.0, -1.0]] * 6)
    np.testing.assert_array_equal(tuned.actuator_forcerange, [[-1.5, 1.5]] * 6)
    for name, value in (("dof_damping", 0.1), ("dof_frictionloss", 0.2), ("dof_armature", 0.03)):
        np.testing.assert_array_equal(getattr(tuned, name)[:6], value)


def test_cameras_look_at_their_targets() -> None:
    camera = SceneCamera(name="side", pos=(0.5, -0.4, 0.3), lookat=(0.1, 0.0, 0.05), fovy=60.0)
    carried = SceneCamera(name="palm", pos=(0.0, 0.05, 0.0), lookat=(0.0, 0.0, -0.1), parent="gripper")
    model = build_model(MujocoOptions(cameras=(camera, carried)), ROBOT, visual=True)
    drawn = mujoco.MjData(model)
    mujoco.mj_forward(model, drawn)
    forward = -drawn.camera("side").xmat.reshape(3, 3)[:, 2]
    towards = np.subtract(camera.lookat, camera.pos)
    np.testing.assert_allclose(forward, towards / np.linalg.norm(towards), atol=1e-12)
    assert drawn.camera("side").xmat.reshape(3, 3)[2, 1] > 0, "upside down"
    assert model.camera("side").fovy == 60.0
    assert model.camera("palm").bodyid == model.body("gripper").id


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (SceneCamera(name="top", pos=(0, 0, 1), lookat=(0, 0, 0)), "the scene has a camera 'top' already"),
        (
            SceneCamera(name="c", pos=(0, 0, 1), lookat=(0, 0, 0), parent="hand"),
            "no body 'hand'; the bodies are: .*gripper",
        ),
    ],
)
def test_impossible_cameras_are_refused(camera: SceneCamera, message: str) -> None:
    with pytest.raises(HardwareError, match=message):
        build_model(MujocoOptions(cameras=(camera,)), ROBOT, visual=True)


def test_another_robot_with_position_actuators_works(tmp_path: Path) -> None:
    robot = other_robot(tmp_path, '<position joint="slide" kp="10"/>')
    assert build_model(MujocoOptions(scene=scene("empty")), robot, visual=False).nu == 1


@pytest.mark.parametrize("actuators", ["", '<motor joint="slide"/>'])
def test_a_joint_without_position_actuator_is_named(tmp_path: Path, actuators: str) -> None:
    with pytest.raises(HardwareError, match=r"other.xml has no position actuator for joint 'slide'"):
        build_model(MujocoOptions(), other_robot(tmp_path, actuators), visual=False)


def test_a_missing_joint_is_named(tmp_path: Path) -> None:
    robot = attrs.evolve(so101(), description=other_robot(tmp_path, "").description)
    with pytest.raises(HardwareError, match=r"other.xml has no joint 'shoulder_pan'; it has: slide"):
        build_model(MujocoOptions(), robot, visual=False)


def test_a_missing_or_broken_mjcf_is_named(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match=r"robot 'so101' has no MJCF to simulate: set robot\.description\.mjcf"):
        build_model(MujocoOptions(), attrs.evolve(ROBOT, description=Description()), visual=False)
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><world/></mujoco>")
    with pytest.raises(HardwareError, match=r"broken\.xml:1: MuJoCo cannot load it: .*unrecognized element"):
        build_model(MujocoOptions(), attrs.evolve(ROBOT, description=Description(mjcf=path)), visual=False)


@settings(max_examples=50, deadline=None)
@given(
    arrays(np.float64, st.tuples(st.integers(1, 30), st.just(3), st.just(3)), elements=st.floats(-1, 1, width=32)),
    st.sampled_from([0.05, 0.3, 1.0]),
)
def test_clustering_moves_corners_by_less_than_a_cell(triangles: np.ndarray, grid: float) -> None:
    vertices, faces = cluster(triangles, grid)
    corners = triangles.reshape(-1, 3)
    nearest = np.linalg.norm(vertices[:, None] - corners[None], axis=2).min(axis=1)
    assert (nearest < grid * np.sqrt(3) + 1e-9).all()
    assert len(vertices) <= len(corners)
    assert len(faces) <= len(triangles)
    if len(faces):
        assert 0 <= faces.min() <= faces.max() < len(vertices)
        assert (np.sort(faces, axis=1)[:, 1:] != np.sort(faces, axis=1)[:, :-1]).all(), "a collapsed triangle was kept"


def test_clustering_keeps_orientation() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    vertices, faces = cluster(np.concatenate([triangle, np.roll(triangle, 1, axis=1)]), 0.1)
    assert len(faces) == 1, "the same triangle, begun at another corner, was kept twice"
    a, b, c = vertices[faces[0]]
    assert np.cross(b - a, c - a)[2] > 0


def test_stl_in_text_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.stl"
    path.write_text("solid thing\nfacet normal 0 0 1\n" * 10)
    with pytest.raises(HardwareError, match=r"text.stl: not a binary STL file"):
        read_stl(path)
