"""Picks the cube and puts it into the bin."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.task import Task
from ibrobot_mujoco.experts.trajectory import Expectation
from ibrobot_mujoco.experts.way import (
    GRASP_TURN_RAD,
    HOVER_TURN_RAD,
    SETTLE_S,
    UP,
    Way,
    across,
    down,
    is_at,
    is_held,
)

DELIVERED_M = 0.07
"""A cube with a smaller horizontal distance to the bin's centre is in the bin [m]."""


class PickTask(Task):
    """The scripted policy of scene `pick_cube`; the base of the experts that put cubes into bins."""

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        self.deliver(way, 0, scene[:7], scene[7:10])
        way.to("return", home, clear=True, expects=is_delivered(0, scene[7:10]))

    def deliver(self, way: Way, first: int, cube: Vector, spot: Vector) -> None:
        """Put the cube whose pose begins at index `first` of the ground truth into a bin, at `spot`, shape (3,)."""
        hand, options = self.hand, self.options
        opened, closed = options.gripper_open, options.gripper_closed
        place, tool = cube[:3], down(across(cube, hand.inward(cube)))
        hover = hand.reach(place + options.hover_height * UP, tool, way.at, opened, HOVER_TURN_RAD)
        grasp = hand.reach(place, tool, hover, opened, GRASP_TURN_RAD)
        over = spot + options.release_height * UP
        release = hand.reach(over, down(hand.inward(spot)), hover, closed, HOVER_TURN_RAD)
        way.grasp(hand, hover, grasp, closed, is_at(first, place))
        way.to("lift", hand.grip(hover, closed), clear=True)
        way.to("carry", release, clear=True, expects=is_held(first, hand))
        way.to("open", hand.grip(release, opened), clear=True)
        way.rest("open", SETTLE_S, clear=True)


def is_delivered(first: int, bin_centre: Vector) -> Expectation:
    """Expects the object whose position begins at index `first` of the ground truth to be in a bin."""
    return lambda state, scene: bool(np.hypot(*(scene[first : first + 3] - bin_centre)[:2]) <= DELIVERED_M)
