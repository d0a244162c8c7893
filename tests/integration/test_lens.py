"""The lens that `ibrobot camera calibrate` measures is that of MuJoCo's camera."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ibrobot_mujoco.gl import choose

from ibrobot_core.errors import MissingDependency

pytestmark = pytest.mark.integration

WIDTH, HEIGHT, FOVY_DEG = 640, 480, 45.0
POSES = [
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.32), (0.5, 0.0, 0.0, 0.0, 0.0, 0.34), (-0.5, 0.0, 0.0, 0.0, 0.0, 0.34),
    (0.0, 0.5, 0.0, 0.0, 0.0, 0.34), (0.0, -0.5, 0.0, 0.0, 0.0, 0.34), (0.3, 0.3, 0.1, -0.12, -0.08, 0.45),
    (-0.3, 0.3, -0.1, 0.12, -0.08, 0.45), (0.3, -0.3, 0.2, -0.12, 0.08, 0.45), (-0.3, -0.3, -0.2, 0.12, 0.08, 0.45),
    (0.4, 0.4, 0.0, 0.05, 0.05, 0.5), (-0.4, 0.2, 0.0, -0.1, 0.0, 0.5), (0.1, -0.6, 0.0, 0.1, 0.0, 0.45),
]  # fmt: skip
"""Rotation vector [rad] and centre [m] of the board in the frame of the camera: x right, y down, z ahead."""


def test_the_lens_of_a_simulated_camera(tmp_path: Path) -> None:
    try:
        chosen = {"MUJOCO_GL": choose()}
    except MissingDependency as missing:
        pytest.skip(f"nothing renders here: {missing}")
    # In a process of its own: MuJoCo chooses when it is imported.
    done = subprocess.run(
        [sys.executable, __file__, tmp_path], env={**os.environ, **chosen}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    matrix = np.array(json.loads(done.stdout))
    focal = HEIGHT / 2 / np.tan(np.radians(FOVY_DEG) / 2)
    np.testing.assert_allclose(np.diag(matrix)[:2], focal, rtol=0.005)
    np.testing.assert_allclose(matrix[:2, 2], [WIDTH / 2, HEIGHT / 2], atol=2.0)


def measured(folder: Path) -> list[list[float]]:
    """The camera matrix from rendered pictures of a board."""
    import cv2
    import mujoco
    from ibrobot_camera.intrinsics.board import Board
    from ibrobot_camera.intrinsics.solve import solve
    from ibrobot_camera.intrinsics.views import find

    board = Board()
    picture = board.pattern.generateImage((60 * board.columns, 60 * board.rows))
    cv2.imwrite(str(folder / "board.png"), cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    x, y = board.columns * board.square / 2000, board.rows * board.square / 2000
    # The last point makes the square a solid.
    points = f"{-x} {-y} 0 {x} {-y} 0 {x} {y} 0 {-x} {y} 0 0 0 -0.001"
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco>
          <visual>
            <global offwidth="{WIDTH}" offheight="{HEIGHT}"/>
            <headlight ambient="0.9 0.9 0.9" diffuse="0 0 0" specular="0 0 0"/>
          </visual>
          <asset>
            <texture name="board" type="2d" file="{folder}/board.png"/>
            <material name="board" texture="board"/>
            <mesh name="board" vertex="{points}" texcoord="0 1 1 1 1 0 0 0 0 0"
                  face="0 1 2 0 2 3 0 4 1 1 4 2 2 4 3 3 4 0"/>
          </asset>
          <worldbody>
            <camera name="lens" fovy="{FOVY_DEG}"/>
            <body mocap="true"><geom type="mesh" mesh="board" material="board"/></body>
          </worldbody>
        </mujoco>""")
    data = mujoco.MjData(model)
    views = []
    flip = np.diag([1.0, -1.0, -1.0])  # MuJoCo's cameras look along -z, with y up
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for number, pose in enumerate(POSES):
            turned = flip @ cv2.Rodrigues(np.array(pose[:3]))[0] @ flip
            mujoco.mju_mat2Quat(data.mocap_quat[0], turned.ravel())
            data.mocap_pos[0] = flip @ np.array(pose[3:])
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="lens")
            views.append(find(np.ascontiguousarray(renderer.render()[:, :, ::-1]), board, f"view {number}"))
    result = solve([view for view in views if view is not None])
    lens: list[list[float]] = result.matrix.tolist()
    return lens


if __name__ == "__main__":
    print(json.dumps(measured(Path(sys.argv[1]))))
