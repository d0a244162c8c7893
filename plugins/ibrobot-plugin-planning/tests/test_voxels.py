"""Voxels from point clouds and depth images."""

from __future__ import annotations

import numpy as np
import pytest
from ibrobot_kinematics.poses import pose_at
from ibrobot_planning.world.voxels import depth_points, voxels

from ibrobot_core.api import Pose

K = np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]])


def test_points_fill_their_cells():
    points = np.array([[0.001, 0.001, 0.001], [0.009, 0.002, 0.003], [-0.001, 0, 0], [np.nan, 0, 0]])
    found = voxels(points, 0.01)
    assert found is not None
    assert sorted(map(tuple, found.cells.tolist())) == [(-1, 0, 0), (0, 0, 0)]
    np.testing.assert_allclose(found.centres[found.cells[:, 0] == -1], [[-0.005, 0.005, 0.005]])


def test_outliers_can_be_dropped():
    points = np.array([[0.001, 0.001, 0.001], [0.009, 0.002, 0.003], [0.5, 0.5, 0.5]])
    found = voxels(points, 0.01, least_points=2)
    assert found is not None
    assert found.cells.tolist() == [[0, 0, 0]]
    assert voxels(points, 0.01, least_points=3) is None


def test_depth_images_become_points_of_the_cameras_frame():
    depth = np.zeros((30, 40))
    depth[15, 20], depth[15, 30], depth[0, 0], depth[1, 1] = 0.5, 1.0, np.nan, 9.0
    # The optical axis looks along the world's x, the picture's right is the world's -y.
    camera = pose_at((0, 0, 0.2), (-np.pi / 2, 0, -np.pi / 2))
    np.testing.assert_allclose(depth_points(depth, K, camera), [[0.5, 0, 0.2], [1.0, -0.1, 0.2]], atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: voxels(np.zeros((3, 2)), 0.01), r"points have shape \(3, 2\)"),
        (lambda: voxels(np.zeros((3, 3)), 0.0), "size is 0.0 m, must be above 0"),
        (lambda: voxels(np.zeros((3, 3)), 0.01, least_points=0), "least_points is 0, must be at least 1"),
        (lambda: depth_points(np.zeros(3), K, Pose()), r"depth has shape \(3,\)"),
        (lambda: depth_points(np.zeros((3, 3)), np.zeros((3, 3)), Pose()), "focal lengths above 0"),
    ],
)
def test_arrays_of_other_shapes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
