"""The left arm picks the bar up, and hands it to the right one."""

from __future__ import annotations

from typing import ClassVar, override

import numpy as np

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.task import Task
from ibrobot_mujoco.experts.way import (
    GRASP_TURN_RAD,
    HOVER_TURN_RAD,
    SETTLE_S,
    UP,
    Way,
    axes_of,
    down,
    is_at,
    is_held,
)

_GRIP_M = 0.055
"""Distance of both grips from the middle of the bar [m]."""
_MEETING = np.array([0.16, 0.0, 0.11])
"""Where the middle of the bar is when it changes hands [m]."""
_END = np.array([0.19, -0.2, 0.13])
"""Where the right arm takes the bar [m]."""
_CLEAR_M = 0.07
_LIFTED_M = 0.05
LEFT = np.array([0.0, 1.0, 0.0])
_HELD_M = _GRIP_M + 0.035


class HandoverTask(Task):
    """The scripted policy of scene `handover`."""

    sides: ClassVar[tuple[str, ...]] = ("left_", "right_")

    @override
    def plan(self, way: Way, scene: Vector, home: Vector) -> None:
        held = is_held(0, self.hands[0], _HELD_M)(way.at, scene) and scene[2] > _LIFTED_M
        (self._take if held else self._present)(way, scene)

    def _present(self, way: Way, scene: Vector) -> None:
        """The left arm holds the bar where the right one can reach it, and waits for another plan."""
        (left, right), options = self.hands, self.options
        opened, closed = options.gripper_open, options.gripper_closed
        bar, axis = scene[:3], _axis(scene)
        along = float(np.arctan2(axis[1], axis[0]))
        grip = bar + _GRIP_M * axis
        heading = _nearest(along - np.pi / 2, left.inward(grip))
        hover = left.reach(grip + options.hover_height * UP, down(heading), way.at, opened, HOVER_TURN_RAD)
        grasp = left.reach(grip, down(heading), hover, opened, GRASP_TURN_RAD)
        # At the meeting, the bar lies along y.
        tool = down(heading - along + np.pi / 2)
        present = left.reach(_MEETING + _GRIP_M * LEFT, tool, left.grip(hover, closed), closed, GRASP_TURN_RAD)
        beside = _MEETING - _GRIP_M * LEFT + _CLEAR_M * UP
        ready = right.reach(beside, down(right.inward(beside)), present, opened, HOVER_TURN_RAD)
        way.grasp(left, hover, grasp, closed, is_at(0, bar))
        way.to("lift", left.grip(hover, closed), clear=True)
        way.to("present", present, clear=True, expects=is_held(0, left, _HELD_M))
        way.to("meet", ready, clear=True, expects=is_held(0, left, _HELD_M))
        way.rest("look", SETTLE_S, clear=True, expects=lambda state, seen: False)

    def _take(self, way: Way, scene: Vector) -> None:
        """The right arm takes the bar from where it is in the left hand."""
        (left, right), options = self.hands, self.options
        opened, closed = options.gripper_open, options.gripper_closed
        axis = _axis(scene)
        grip = scene[:3] - _GRIP_M * axis
        tool = down(_nearest(float(np.arctan2(axis[1], axis[0])) - np.pi / 2, right.inward(grip)))
        ready = right.reach(grip + _CLEAR_M * UP, tool, way.at, opened, HOVER_TURN_RAD)
        take = right.reach(grip, tool, ready, opened, GRASP_TURN_RAD)
        taken = right.grip(take, closed)
        freed = left.grip(taken, opened)
        hand = left.tip(way.at)
        away = left.reach(hand + _CLEAR_M * UP, down(left.inward(hand)), freed, opened, HOVER_TURN_RAD)
        end = right.reach(_END, down(right.inward(_END)), away, closed, HOVER_TURN_RAD)
        way.to("ready", ready, clear=True, expects=is_held(0, left, _HELD_M))
        way.to("take", take, expects=is_held(0, left, _HELD_M))
        way.to("grasp", taken)
        way.rest("grasp", SETTLE_S)
        way.to("let go", freed)
        way.rest("let go", SETTLE_S)
        way.to("leave", away)
        way.to("carry", end, clear=True, expects=is_held(0, right, _HELD_M))
        way.rest("return", SETTLE_S, clear=True, expects=is_held(0, right, _HELD_M))


def _axis(scene: Vector) -> Vector:
    """Direction of the bar to the left, shape (3,)."""
    axis = axes_of(scene[:7])[:, 1]
    return axis if axis[1] >= 0 else -axis


def _nearest(heading: float, to: float) -> float:
    """The heading or its opposite, whichever is nearer to a direction [rad]."""
    return float(heading + np.pi * np.round((to - heading) / np.pi))
