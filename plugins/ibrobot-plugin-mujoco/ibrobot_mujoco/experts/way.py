"""Waypoints of the experts: hands that reach poses, and paths built waypoint by waypoint."""

from __future__ import annotations

import math

import attrs
import numpy as np
from ibrobot_kinematics import KinematicModel, Target, solve
from ibrobot_kinematics.rotations import from_quaternion
from numpy.typing import NDArray

from ibrobot_core.api import Vector
from ibrobot_mujoco.experts.trajectory import Expectation, Limits, Segment, anything, duration

SETTLE_S = 0.2
"""Pause after the gripper has closed or opened [s]."""
GRASP_TURN_RAD, HOVER_TURN_RAD = 0.35, 1.2
"""Allowed deviation of the gripper from vertical, if the arm cannot reach vertical [rad]."""
MOVED_M = 0.01
"""An object further than this from its planned position has moved [m]."""
LOST_M = 0.03
"""An object further than this from the tip is not held [m]."""
_STEP_M = 0.02
"""Distance between waypoints of a straight line [m]."""
UP = np.array([0.0, 0.0, 1.0])


@attrs.frozen(eq=False)
class Hand:
    """An arm with its gripper.

    Attributes:
        arm: kinematics, in the frame of the arm's base.
        columns: indices of the arm's joints in the robot's order.
        gripper: index of the gripper's joint in the robot's order.
        base: x, y, z [m] and yaw [rad] of the arm's base.
    """

    arm: KinematicModel
    columns: NDArray[np.intp]
    gripper: int
    base: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def reach(self, position: Vector, rotation: Vector, start: Vector, gripper: float, turn: float) -> Vector:
        """Joints with the tip at a pose in the robot's frame, shape (J,) [rad]; others as in `start`.

        Raises:
            UnreachableError: if it is out of reach.
        """
        frame = self._frame()
        target = Target(frame.T @ (position - self.base[:3]), frame.T @ rotation)
        result = start.copy()
        result[self.columns] = solve(self.arm, target, start[self.columns], rotation_tolerance=turn)
        return self.grip(result, gripper)

    def line(self, start: Vector, position: Vector, rotation: Vector, motion: Vector, gripper: float) -> list[Vector]:
        """Joints along a straight line of the tip from `position` by `motion` [m], a waypoint at least every 2 cm.

        Raises:
            UnreachableError: if a part of it is out of reach.
        """
        points = [start]
        steps = max(1, round(float(np.linalg.norm(motion)) / _STEP_M))
        for done in np.linspace(0.0, 1.0, steps + 1)[1:]:
            points.append(self.reach(position + done * motion, rotation, points[-1], gripper, GRASP_TURN_RAD))
        return points[1:]

    def grip(self, joints: Vector, gripper: float) -> Vector:
        """Return the joints with another position of the gripper."""
        result = joints.copy()
        result[self.gripper] = gripper
        return result

    def tip(self, joints: Vector) -> Vector:
        """Position of the tip in the robot's frame [m], shape (3,)."""
        return self._frame() @ self.arm.forward(joints[self.columns]).position + self.base[:3]

    def inward(self, position: Vector) -> float:
        """Direction [rad] from a position, shape (3,), to the arm's base, seen from above."""
        return float(np.arctan2(self.base[1] - position[1], self.base[0] - position[0]))

    def _frame(self) -> Vector:
        c, s = math.cos(self.base[3]), math.sin(self.base[3])
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@attrs.define(eq=False)
class Way:
    """A path of segments, each beginning where the previous one ends."""

    at: Vector
    """Joints [rad], shape (J,)."""
    limits: Limits
    segments: list[Segment] = attrs.field(factory=list)

    def to(self, name: str, joints: Vector, *, clear: bool = False, expects: Expectation = anything) -> None:
        """Move straight to `joints` [rad], shape (J,)."""
        self._add(name, joints, duration(self.at, joints, self.limits), clear, expects)

    def rest(self, name: str, duration_s: float, *, clear: bool = False, expects: Expectation = anything) -> None:
        """Stay in place."""
        self._add(name, self.at, duration_s, clear, expects)

    def grasp(self, hand: Hand, hover: Vector, grasp: Vector, closed: float, expects: Expectation) -> None:
        """Come down from `hover` to `grasp`, both [rad], shape (J,), and close the hand to `closed` [rad]."""
        self.to("hover", hover, clear=True, expects=expects)
        self.to("descend", grasp, expects=expects)
        self.to("close", hand.grip(grasp, closed))
        self.rest("close", SETTLE_S)

    def _add(self, name: str, end: Vector, duration_s: float, clear: bool, expects: Expectation) -> None:
        self.segments.append(Segment(name, self.at, end, duration_s, clear, expects))
        self.at = end


def axes_of(pose: Vector) -> Vector:
    """The axes of a pose, position and quaternion wxyz, as columns, shape (3, 3)."""
    return from_quaternion(np.roll(pose[3:7], -1))


def down(heading: float) -> Vector:
    """Axes of a tip that points straight down and whose jaws close along `heading` [rad], shape (3, 3)."""
    return np.array(
        [
            [np.cos(heading), np.sin(heading), 0.0],
            [np.sin(heading), -np.cos(heading), 0.0],
            [0.0, 0.0, -1.0],
        ]
    )


def across(pose: Vector, near: float) -> float:
    """Direction [rad] across two faces of a cube on the table that is nearest to `near` [rad]."""
    axes = axes_of(pose)
    face_axis = axes[:2, np.argmin(np.abs(axes[2]))]
    face = np.arctan2(face_axis[1], face_axis[0])
    quarter = np.pi / 2
    return float(face + quarter * np.round((near - face) / quarter))


def is_at(first: int, position: Vector) -> Expectation:
    """Expect the object whose position begins at index `first` of the ground truth to be at `position` [m]."""
    return lambda state, scene: bool(np.linalg.norm(scene[first : first + 3] - position) <= MOVED_M)


def is_held(first: int, hand: Hand, within: float = LOST_M) -> Expectation:
    """Expect the object whose position begins at index `first` of the ground truth to be in a hand."""
    return lambda state, scene: bool(np.linalg.norm(scene[first : first + 3] - hand.tip(state)) <= within)
