"""The robot's shapes, for a robot that nothing here knows."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
from ibrobot_kinematics.rotations import from_quaternion
from ibrobot_web.scene import make_scene

LINK = '<geom type="capsule" size="0.02 0.08" fromto="0 0 0 0 0 0.16" rgba="0.2 0.4 0.6 1"/>'


def seven_joints() -> str:
    """An arm of six hinges and a slide, with a site at its tip and a collision shape that is not shown."""
    inner = '<site name="tip" pos="0 0 0.1"/><geom type="sphere" size="0.05" group="3"/>'
    inner += '<camera name="eye" pos="0 0 0.05" fovy="50"/>'
    for i in reversed(range(7)):
        kind, axis = ("slide", "0 0 1") if i == 6 else ("hinge", ("0 0 1", "0 1 0")[i % 2])
        inner = (
            f'<body name="link{i}" pos="0 0 0.16"><joint name="j{i}" type="{kind}" axis="{axis}" range="-1 1"/>'
            f"{LINK}{inner}</body>"
        )
    return f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{inner}</worldbody></mujoco>'


def test_bodies_joints_and_shapes_of_any_robot(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(seven_joints())
    scene = make_scene({"mjcf": str(tmp_path / "arm.xml"), "urdf": None, "tip": "tip"})
    assert scene["problem"] == ""
    assert [body["parent"] for body in scene["bodies"]] == [-1, *range(7)]
    joints = [joint for body in scene["bodies"] for joint in body["joints"]]
    assert [joint["name"] for joint in joints] == [f"j{i}" for i in range(7)]
    assert [joint["type"] for joint in joints] == ["hinge"] * 6 + ["slide"]
    shapes = [geom for body in scene["bodies"] for geom in body["geoms"]]
    assert [geom["type"] for geom in shapes] == ["plane"] + ["capsule"] * 7
    assert scene["cameras"] == [{"body": 7, "pos": [0.0, 0.0, 0.05], "quat": [1.0, 0.0, 0.0, 0.0], "fovy": 50.0}]
    assert scene["tips"][""] == {"body": 7, "pos": [0.0, 0.0, 0.1], "quat": [1.0, 0.0, 0.0, 0.0]}


def test_a_robot_of_several_arms_has_its_model_several_times(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(seven_joints())
    arms = {"left_": [0.0, 0.2, 0.0, 0.0], "right_": [0.0, -0.2, 0.0, 0.0]}
    scene = make_scene({"mjcf": str(tmp_path / "arm.xml"), "urdf": None, "tip": "tip", "arms": arms})
    joints = [joint["name"] for body in scene["bodies"] for joint in body["joints"]]
    assert joints == [f"{arm}j{i}" for arm in arms for i in range(7)]
    assert {arm: scene["bodies"][tip["body"]]["name"] for arm, tip in scene["tips"].items()} == {
        "left_": "left_link6",
        "right_": "right_link6",
    }
    bases = [body["pos"][1] for body in scene["bodies"] if body["name"].endswith("link0")]
    assert bases == [0.2, -0.2]


def test_meshes_are_few_triangles(tmp_path: Path) -> None:
    grid = np.linspace(0, 0.1, 60)
    points = [(x, y, 0.02 * np.sin(60 * x)) for x in grid for y in grid]
    vertices = " ".join(f"{value:.5f}" for point in points for value in point)
    faces = " ".join(f"{i} {i + 1} {i + 60} {i + 1} {i + 61} {i + 60}" for i in range(60 * 59) if i % 60 < 59)
    text = (
        f'<mujoco><asset><mesh name="m" inertia="shell" vertex="{vertices}" face="{faces}"/></asset><worldbody>'
        '<body name="b"><joint name="j"/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    (tmp_path / "mesh.xml").write_text(text)
    scene = make_scene({"mjcf": str(tmp_path / "mesh.xml"), "urdf": None, "tip": "b"})
    (mesh,) = scene["meshes"]
    found = np.frombuffer(base64.b64decode(mesh["faces"]), "<u4").reshape(-1, 3)
    corners = np.frombuffer(base64.b64decode(mesh["vertices"]), "<f4").reshape(-1, 3)
    assert 0 < len(found) < 6962
    assert found.max() < len(corners)
    diagonal = np.linalg.norm(corners[:, None] - corners[None], axis=2).max()
    np.testing.assert_allclose(diagonal, 0.1 * np.sqrt(2), atol=0.01)


def test_a_urdf_without_an_mjcf(tmp_path: Path) -> None:
    shape = '<visual><geometry><box size="0.1 0.1 0.3"/></geometry></visual>'
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="arm"><link name="base"/><link name="upper">{shape}'
        f'<inertial><mass value="1"/>{inertia}</inertial></link>'
        '<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    scene = make_scene({"mjcf": None, "urdf": str(tmp_path / "arm.urdf"), "tip": "upper"})
    assert scene["problem"] == ""
    assert [joint["name"] for body in scene["bodies"] for joint in body["joints"]] == ["shoulder"]


def test_a_robot_without_shapes_says_why(tmp_path: Path) -> None:
    scene = make_scene({"mjcf": None, "urdf": None, "tip": "tip"})
    assert scene["problem"] == "the robot has no model: set robot.description.mjcf or robot.description.urdf"
    (tmp_path / "broken.xml").write_text("<mujoco>")
    broken = make_scene({"mjcf": str(tmp_path / "broken.xml"), "urdf": None, "tip": "tip"})
    assert broken["bodies"] == []
    assert "XML" in broken["problem"]


def test_a_broken_urdf_beside_an_mjcf_hides_no_shapes(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(seven_joints())
    (tmp_path / "arm.urdf").write_text("<robot>")
    mount = {"camera": True, "rpy": [0.0, 0.0, 0.0], "quaternion": None, "xyz": [0.0, 0.0, 0.0]}
    mounts = [{**mount, "name": "ahead", "frame": "ahead_frame", "parent": "link2"}]
    described = {"mjcf": str(tmp_path / "arm.xml"), "urdf": str(tmp_path / "arm.urdf"), "tip": "tip", "mounts": mounts}
    scene = make_scene(described)
    assert [camera["body"] for camera in scene["cameras"]] == [7, 3]


def test_cameras_of_the_robot_yaml_are_where_their_mounts_say(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(seven_joints())
    mount = {"camera": True, "rpy": [0.0, 0.0, 0.0], "quaternion": None, "xyz": [0.0, 0.0, 0.0]}
    mounts = [
        {**mount, "name": "ahead", "frame": "ahead_frame", "parent": "link2", "xyz": [0.1, 0.0, 0.2]},
        {**mount, "name": "plate", "frame": "plate_frame", "parent": "link6", "camera": False, "xyz": [0.0, 0.0, 0.1],
         "rpy": [0.0, 0.0, np.pi / 2]},
        {**mount, "name": "down", "frame": "down_frame", "parent": "plate_frame", "xyz": [0.1, 0.0, 0.0],
         "rpy": [0.0, np.pi / 2, 0.0]},
        {**mount, "name": "lost", "frame": "lost_frame", "parent": "nowhere"},
    ]  # fmt: skip
    scene = make_scene({"mjcf": str(tmp_path / "arm.xml"), "urdf": None, "tip": "tip", "mounts": mounts})
    _, ahead, down = scene["cameras"]
    assert (ahead["body"], ahead["pos"]) == (3, [0.1, 0.0, 0.2])
    assert down["body"] == 7
    np.testing.assert_allclose(down["pos"], [0.0, 0.1, 0.1], atol=1e-6)
    for camera, direction, up in ((ahead, [1, 0, 0], [0, 0, 1]), (down, [0, 0, -1], [0, 1, 0])):
        turn = from_quaternion(np.roll(camera["quat"], -1))
        np.testing.assert_allclose(turn @ [0, 0, -1], direction, atol=1e-4)
        np.testing.assert_allclose(turn @ [0, 1, 0], up, atol=1e-4)
