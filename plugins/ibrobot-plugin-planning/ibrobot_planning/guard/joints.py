"""Joints of commands as those of the model that the guard checks: an arm's own, or the pose of a base that drives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import numpy as np
import pinocchio

from ibrobot_core.api import Robot, Vector
from ibrobot_planning.guard.options import BASE, BaseOptions
from ibrobot_planning.world.arm import Arm, LinkShape
from ibrobot_planning.world.coal_shapes import hull

_LATE_TICKS = 2
"""A base takes a velocity so much later, and what is measured of it is older, than a joint with a servo."""
_STRAIGHT = 1e-6
"""Turns below this count as none [rad]."""


class ModelJoints:
    """Joints that the model has: nothing is converted.

    Args:
        columns: of these joints among the robot's, shape (J,).
    """

    def __init__(self, columns: np.ndarray[tuple[int], np.dtype[np.intp]]) -> None:
        self.columns = columns

    def note(self, measured: Vector) -> None:
        """Take in where the joints are, shape (J,); NaN where one is not measured."""

    def path(self, commands: Vector) -> Vector:
        """Configurations of the model on the way from where the robot is, by commands of shape (N, J)."""
        return commands

    def strays(self, away: Vector, step: Vector, ahead: Vector) -> Vector:
        """How far the model's joints may be from a configuration of `path`.

        Args:
            away: distance of each joint from its commands, shape (J,).
            step: how far each joint goes at most within a tick, shape (J,).
            ahead: how far until it rests, shape (J,).
        """
        return away

    def rates(self, gradients: Vector) -> Vector:
        """What changes with the model's joints, shape (K, M), by the change of commands, shape (K, J)."""
        return gradients


class BaseWays(ModelJoints):
    """Joints that are the ways of a base along its own axes, in a model whose joints are the pose (x, y, theta).

    Where the base stands when it is measured first is the origin: the frame of the world. It drives to no place, and
    commands may be ahead of it or behind: so its pose is the sum of the motions that are measured, and paths begin
    there. In between, x, y and theta move evenly, on an arc.

    Args:
        columns: of the axes among the robot's joints, shape (J,).
        axes: which of x, y and theta each one is: 0, 1 or 2.
    """

    def __init__(self, columns: np.ndarray[tuple[int], np.dtype[np.intp]], axes: Sequence[int]) -> None:
        super().__init__(columns)
        self._axes = np.zeros((len(axes), 3))
        self._axes[np.arange(len(axes)), list(axes)] = 1.0
        self._ways: Vector = np.full(len(axes), np.nan)
        self.pose: Vector = np.zeros(3)
        """Where the base is: x, y [m] and theta [rad]."""

    @override
    def note(self, measured: Vector) -> None:
        if not np.isfinite(measured).all():
            return
        if np.isfinite(self._ways).all():
            self.pose = self._driven(measured[None])[0]
        self._ways = measured.copy()

    @override
    def path(self, commands: Vector) -> Vector:
        # It drives as its setpoint moves, also if that is behind; if it is ahead, it catches up.
        ahead, along = commands[0] - self._ways, commands[-1] - commands[0]
        from_here = commands[0] - np.where(ahead * along > 0, ahead, 0.0)
        whole = np.concatenate([from_here[None], commands])
        start = np.where(np.isnan(self._ways), whole[0], self._ways)
        return self._driven(np.concatenate([start[None], start + whole[1:] - whole[0]]))

    @override
    def strays(self, away: Vector, step: Vector, ahead: Vector) -> Vector:
        x, y, turn = (away + _LATE_TICKS * step) @ self._axes
        dx, dy, dturn = ahead @ self._axes
        # It may turn before it drives or the other way round, instead of evenly.
        along = np.hypot(x, y) + np.hypot(dx, dy) * dturn
        return np.array([along, along, turn])

    @override
    def rates(self, gradients: Vector) -> Vector:
        cos, sin = np.cos(self.pose[2]), np.sin(self.pose[2])
        turned = gradients @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(turned @ self._axes.T)

    def _driven(self, ways: Vector) -> Vector:
        """The poses to which ways from where the base is lead, shape (N, 3)."""
        start = np.where(np.isfinite(self._ways), self._ways, ways[0])
        x, y, turn = ((ways - start) @ self._axes).T
        straight = np.abs(turn) < _STRAIGHT
        safe = np.where(straight, 1.0, turn)
        ahead, aside = (
            np.where(straight, 1.0, np.sin(safe) / safe),
            np.where(straight, turn / 2, (1 - np.cos(safe)) / safe),
        )
        along, across = ahead * x - aside * y, aside * x + ahead * y
        cos, sin = np.cos(self.pose[2]), np.sin(self.pose[2])
        return np.stack(
            [self.pose[0] + cos * along - sin * across, self.pose[1] + sin * along + cos * across, self.pose[2] + turn],
            axis=1,
        )


def footprint(options: BaseOptions, robot: Robot) -> tuple[Arm, BaseWays]:
    """The model of a base: a pose, and the prism above its footprint; and its ways."""
    names = (options.x, options.y, options.theta)
    model, number = pinocchio.Model(), 0
    x, y, z = np.eye(3)
    slide, hinge = pinocchio.JointModelPrismaticUnaligned, pinocchio.JointModelRevoluteUnaligned
    for name, joint in zip(names, (slide(x), slide(y), hinge(z)), strict=True):
        number = model.addJoint(number, joint, pinocchio.SE3.Identity(), name)
    corners = np.array([(*corner, height) for corner in options.footprint for height in (options.bottom, options.top)])
    arm = Arm(
        joint_names=names,
        model=model,
        columns=np.arange(3, dtype=np.intp),
        reference=np.zeros(3),
        lower=np.zeros(3),
        upper=np.zeros(3),
        shapes=(LinkShape(BASE, number, np.eye(4), hull(corners)),),
        frames={"world": (0, np.eye(4)), BASE: (number, np.eye(4))},
        numbers=np.array([1, 2, 3], dtype=np.intp),
        slides=np.array([True, True, False]),
    )
    axes = [axis for axis, name in enumerate(names) if name in robot.joint_names]
    return arm, BaseWays(robot.indices([names[axis] for axis in axes]), axes)
