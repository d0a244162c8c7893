"""Puts the cube on the other one."""

from __future__ import annotations

from typing import override

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.task import Task
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

PAD_M = 0.0124
"""Distance of the fixed jaw's pad from the tip, towards which the moving jaw pushes what it closes on [m]."""
_DROP_M = 0.003
"""Height from which the cube is let go [m]."""
_LOOSE_M = 0.006
"""Retreat after release, which frees the cube from the fixed jaw [m]."""


class StackTask(Task):
    """The scripted policy of scene `stack`."""

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        hand, options = self.hand, self.options
        opened, closed = options.gripper_open, options.gripper_closed
        cube, base = scene[:7], scene[7:14]
        tool = down(across(cube, hand.inward(cube)))
        lift = options.hover_height * UP
        hover = hand.reach(cube[:3] + lift, tool, way.at, opened, HOVER_TURN_RAD)
        grasp = hand.reach(cube[:3], tool, hover, opened, GRASP_TURN_RAD)
        size = 2 * cube[2]
        goal = np.array([*base[:2], 2 * base[2] + size / 2])
        tool = down(hand.inward(base))
        held = (PAD_M - size / 2) * tool[:, 0]
        above = hand.reach(goal - held + lift, tool, hover, closed, HOVER_TURN_RAD)
        release = hand.reach(goal - held + _DROP_M * UP, tool, above, closed, GRASP_TURN_RAD)
        loose = hand.reach(goal - held + _DROP_M * UP + _LOOSE_M * tool[:, 0], tool, release, opened, GRASP_TURN_RAD)
        way.grasp(hand, hover, grasp, closed, is_at(0, cube[:3]))
        way.to("lift", hand.grip(hover, closed), clear=True)
        way.to("carry", above, clear=True, expects=is_held(0, hand))
        way.to("lower", release, expects=is_held(0, hand))
        way.to("open", hand.grip(release, opened))
        way.rest("open", SETTLE_S)
        way.to("loosen", loose)
        way.to("rise", hand.grip(above, opened), clear=True)
        way.to("return", home, clear=True, expects=is_at(0, goal))
