"""Voxels from point clouds and depth images."""

from __future__ import annotations

import numpy as np
import pytest
from ibrobot_planning.world.voxels import depth_points, voxels

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
    np.testing.assert_allclose(depth_points(depth, K, 2.0), [[0, 0, 0.5], [0.1, 0, 1.0]], atol=1e-12)


def test_focal_lengths_must_be_above_0():
    with pytest.raises(ValueError, match="focal lengths above 0"):
        depth_points(np.zeros((3, 3)), np.zeros((3, 3)), 2.0)
