"""Pushes the block onto the goal with the closed gripper."""

from __future__ import annotations

from typing import override

import numpy as np
from ibrobot_kinematics import UnreachableError

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.task import Task
from ibrobot_mujoco.experts.way import GRASP_TURN_RAD, HOVER_TURN_RAD, UP, Way, down, is_at

CLOSED_RAD = -0.17
_HEIGHT_M = 0.016
"""Height of the tip while it pushes; the jaws end 9 mm below [m]."""
_APPROACH_M = 0.02
"""Distance between gripper and block when the gripper comes down [m]."""
_NEAR_M = 0.008
"""A block this near to the goal is left alone [m]."""
_MIDDLE_M = 0.0145
"""Middle of the closed jaws, along the direction in which they close [m]."""
_FACES = ((0.0, 0.032, 0.0), (np.pi / 2, 0.016, _MIDDLE_M), (-np.pi / 2, 0.016, _MIDDLE_M))
"""Faces to push with: heading of the jaws relative to the push [rad], distance of the face ahead of the tip, and shift
of the tip against the heading, so that the middle of the face pushes [m]."""


class PushTask(Task):
    """The scripted policy of scene `push`."""

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        block, goal = scene[:3], scene[7:10]
        if np.hypot(*(block - goal)[:2]) > _NEAR_M:
            reasons = []
            for face in _FACES:
                try:
                    self._push(way, face, block, goal, block[2])
                    break
                except UnreachableError as error:
                    reasons.append(error)
            else:
                raise reasons[0]
        near = lambda state, scene: bool(np.hypot(*(scene[:3] - goal)[:2]) <= 1.5 * _NEAR_M)  # noqa: E731
        way.to("return", home, clear=True, expects=near)

    def _push(self, way: Way, face: tuple[float, float, float], block: Vector, goal: Vector, half: float) -> None:
        hand, (turn, ahead, shift) = self.hand, face
        heading = float(np.arctan2(*(goal - block)[1::-1]))
        forward = np.array([np.cos(heading), np.sin(heading), 0.0])
        tool = down(heading + turn)
        aside = shift * tool[:, 0]
        length = float(np.hypot(*(goal - block)[:2]))
        ground = np.array([block[0], block[1], _HEIGHT_M]) - aside
        # The block may be turned, and be touched first at an edge.
        behind = ground - (2**0.5 * half + ahead + _APPROACH_M) * forward
        above = hand.reach(behind + self.options.hover_height * UP, tool, way.at, CLOSED_RAD, HOVER_TURN_RAD)
        here = hand.reach(behind, tool, above, CLOSED_RAD, GRASP_TURN_RAD)
        contact = ground - (half + ahead) * forward
        distance = float(np.dot(contact + length * forward - behind, forward))
        line = hand.line(here, behind, tool, distance * forward, CLOSED_RAD)
        back = behind + (distance - _APPROACH_M) * forward
        away = hand.reach(back, tool, line[-1], CLOSED_RAD, GRASP_TURN_RAD)
        up = hand.reach(back + self.options.hover_height * UP, tool, away, CLOSED_RAD, HOVER_TURN_RAD)
        way.to("hover", above, clear=True, expects=is_at(0, block))
        way.to("descend", here, expects=is_at(0, block))
        for joints in line:
            way.to("push", joints)
        way.to("leave", away)
        way.to("rise", up, clear=True)
