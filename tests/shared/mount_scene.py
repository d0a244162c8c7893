"""The bundled SO-101 in MuJoCo with a camera in its hand, and a board on the table that the camera sees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import cv2
import mujoco
import numpy as np
from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.mounting.shots import Lens
from ibrobot_kinematics.link_chain import Chain
from ibrobot_kinematics.mjcf import read_mjcf
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import exp, quaternion
from ibrobot_kinematics.urdf import read_urdf
from ibrobot_mujoco.render import Renderer
from numpy.typing import NDArray

from ibrobot_core.api import Vector
from ibrobot_core.app import RobotConfig

WIDTH, HEIGHT, FOVY = 640, 480, 45.0
FOCAL = HEIGHT / 2 / np.tan(np.radians(FOVY) / 2)
MATRIX = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1.0]])
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The camera's optical frame in that of its mount."""
BOARD = Board(columns=8, rows=6, square=25.0)
HAND, BASE = "gripper_link", "base_link"
USUAL, SPREAD = np.array([0.0, -0.5, 0.3, 1.2, 0.0, 0.2]), np.array([0.35, 0.3, 0.3, 0.35, 0.6, 0.0])
"""A pose from which the camera sees the board, and deviation from it [rad]."""
FAR_M = 0.33
"""Distance of the board from the camera in the usual pose."""


@attrs.frozen(eq=False)
class Rig:
    """An arm whose camera sees the board in all poses."""

    joints: Vector
    """Of each picture [rad], shape (N, J)."""
    camera: Vector
    """Its optical frame in the hand, shape (4, 4)."""
    board: Vector
    """On the base, shape (4, 4)."""


def rig(config: RobotConfig, rng: np.random.Generator, count: int = 20) -> Rig:
    """A rig with so many poses."""
    assert config.robot.description.urdf is not None
    chain = Chain(read_urdf(config.robot.description.urdf), config.robot.joint_names, HAND, BASE)
    middle = np.array([BOARD.columns, BOARD.rows, 0.0]) * BOARD.square / 2000
    turned = exp(rng.normal(0, 0.25, 3))
    ahead = homogeneous(turned, np.array([0.0, 0.0, FAR_M]) - turned @ middle)
    # Beside the gripper, looking along the fingers (-z of the link).
    camera = homogeneous(
        np.diag([1.0, -1.0, -1.0]) @ exp(rng.normal(0, 0.15, 3)), rng.normal((0, 0.085, -0.045), 0.005)
    )
    board = np.linalg.inv(chain.pose(USUAL)) @ camera @ ahead
    corners = np.asarray(BOARD.pattern.getChessboardCorners(), np.float64).reshape(-1, 3)
    poses: list[Vector] = []
    while len(poses) < count:
        joints = USUAL + rng.normal(0, 1, 6) * SPREAD
        seen = np.linalg.inv(camera) @ chain.pose(joints) @ board
        pixels = Lens((WIDTH, HEIGHT), MATRIX, np.zeros(5)).pixels(corners, seen)
        if seen[2, 2] > 0.5 and ((pixels > 8) & (pixels < np.array([WIDTH, HEIGHT]) - 8)).all():
            poses.append(joints)
    return Rig(np.array(poses), camera, board)


def slipped(rng: np.random.Generator) -> Vector:
    """A board that has slipped by 1 to 4 cm and turned, in its frame, shape (4, 4)."""
    return homogeneous(exp(rng.normal(0, 0.1, 3)), rng.choice([-1, 1], 3) * rng.uniform(0.01, 0.04, 3))


class Scene:
    """The arm, the camera and the board.

    Args:
        config: of the arm.
        camera: its optical frame in the hand, shape (4, 4).
        folder: for the picture on the board.
    """

    def __init__(self, config: RobotConfig, camera: Vector, folder: Path) -> None:
        assert config.robot.description.mjcf is not None
        spec = read_mjcf(config.robot.description.mjcf).spec.copy()
        file = folder / "board.png"
        drawn = BOARD.pattern.generateImage((60 * BOARD.columns, 60 * BOARD.rows))
        cv2.imwrite(str(file), cv2.cvtColor(drawn, cv2.COLOR_GRAY2BGR))
        spec.add_texture(name="board", type=mujoco.mjtTexture.mjTEXTURE_2D, file=str(file))
        material: Any = spec.add_material(name="board")
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "board"
        x, y = BOARD.columns * BOARD.square / 1000, BOARD.rows * BOARD.square / 1000
        # The board in OpenCV's frame: x to the right, y down, seen from -z. The last point makes it a solid.
        points = [0, 0, 0, x, 0, 0, x, y, 0, 0, y, 0, x / 2, y / 2, 0.001]
        spec.add_mesh(
            name="board", uservert=points, usertexcoord=[0, 0, 1, 0, 1, 1, 0, 1, 0, 0],
            userface=[0, 2, 1, 0, 3, 2, 0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4],
        )  # fmt: skip
        body = spec.worldbody.add_body(name="board", mocap=True)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="board", material="board", contype=0, conaffinity=0)
        spec.worldbody.add_camera(name="lens", fovy=FOVY)
        spec.visual.headlight.ambient = [0.8, 0.8, 0.8]
        spec.visual.headlight.diffuse = [0.2, 0.2, 0.2]
        spec.visual.map.znear = 0.005
        self._camera, self._model = camera, spec.compile()
        self._data = mujoco.MjData(self._model)
        self._number = int(self._model.camera("lens").id)
        self._joints = [int(self._model.joint(name).qposadr[0]) for name in config.robot.joint_names]
        self._renderer = Renderer(self._model, self._number, WIDTH, HEIGHT, shadows=False)

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def picture(self, joints: Vector, board: Vector) -> NDArray[np.uint8]:
        """What the camera sees with the board at a place on the base; MuJoCo says where links are. Shape (H, W, 3)."""
        data = self._data
        data.qpos[self._joints] = joints
        mujoco.mj_kinematics(self._model, data)
        placed = self._placed(BASE) @ board
        data.mocap_pos[0], data.mocap_quat[0] = placed[:3, 3], np.roll(quaternion(placed[:3, :3]), 1)
        lens = self._placed(HAND) @ self._camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        self._model.cam_pos[self._number] = lens[:3, 3]
        self._model.cam_quat[self._number] = np.roll(quaternion(lens[:3, :3]), 1)
        mujoco.mj_forward(self._model, data)
        return self._renderer.render(data)

    def _placed(self, link: str) -> Vector:
        body = self._model.body(link.removesuffix("_link")).id
        return homogeneous(self._data.xmat[body].reshape(3, 3), self._data.xpos[body])
