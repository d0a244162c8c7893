"""Grasps the handle of the drawer and pulls."""

from __future__ import annotations

from typing import override

import numpy as np
from ibrobot_kinematics import UnreachableError

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.task import Task
from ibrobot_mujoco.experts.way import GRASP_TURN_RAD, HOVER_TURN_RAD, SETTLE_S, UP, Way, down, is_at

_OPENED_M = 0.095
"""Opening to pull to: beyond the one that counts [m]."""
_ENOUGH_M = 0.085


class DrawerTask(Task):
    """The scripted policy of scene `drawer`."""

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        opening = float(scene[5])
        if opening < _ENOUGH_M:
            along = float(np.arctan2(scene[4], scene[3])) + np.pi / 2
            try:
                self._pull(way, scene, along)
            except UnreachableError:
                self._pull(way, scene, along + np.pi)
        way.to("return", home, clear=True, expects=lambda state, seen: bool(seen[5] >= _ENOUGH_M))

    def _pull(self, way: Way, scene: Vector, heading: float) -> None:
        hand, options, handle, opening = self.hand, self.options, scene[:3], float(scene[5])
        opened, closed, tool = options.gripper_open, options.gripper_closed, down(heading)
        pull = np.array([scene[3], scene[4], 0.0])
        hover = hand.reach(handle + options.hover_height * UP, tool, way.at, opened, HOVER_TURN_RAD)
        grasp = hand.reach(handle, tool, hover, opened, GRASP_TURN_RAD)
        motion = (_OPENED_M - opening) * pull
        line = hand.line(grasp, handle, tool, motion, closed)
        up = hand.reach(handle + motion + options.hover_height * UP, tool, line[-1], opened, HOVER_TURN_RAD)
        way.grasp(hand, hover, grasp, closed, is_at(0, handle))
        for joints in line:
            way.to("pull", joints)
        way.to("open", hand.grip(line[-1], opened))
        way.rest("open", SETTLE_S)
        way.to("rise", up, clear=True)
