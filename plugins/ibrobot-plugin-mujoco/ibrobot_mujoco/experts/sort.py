"""Puts each cube into the bin of its colour."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.pick_cube import PickTask, is_delivered
from ibrobot_mujoco.experts.way import Way

_SPOTS = 0.026 * np.array([(-1, -1, 0), (1, 1, 0), (-1, 1, 0), (1, -1, 0)])
"""Where each cube goes in its bin, from the centre [m], so that none lies on another, shape (4, 3)."""
_BINS = 6
"""Numbers in the ground truth for the centres of both bins."""


class SortTask(PickTask):
    """The scripted policy of scene `sort`."""

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        cubes = (len(scene) - _BINS) // 8  # a pose and the number of a bin for each
        numbers, centres = scene[7 * cubes : 8 * cubes], scene[8 * cubes :].reshape(2, 3)
        arrived = [is_delivered(7 * cube, centres[int(number)]) for cube, number in enumerate(numbers)]
        for cube, number in enumerate(numbers):
            if not arrived[cube](way.at, scene):
                self.deliver(way, 7 * cube, scene[7 * cube : 7 * cube + 7], centres[int(number)] + _SPOTS[cube])
        way.to("return", home, clear=True, expects=lambda state, scene: all(each(state, scene) for each in arrived))
