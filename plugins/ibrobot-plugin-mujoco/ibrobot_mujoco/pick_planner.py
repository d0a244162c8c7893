"""Plans a pick and place: the scene's ground truth -> waypoints by inverse kinematics -> timed joint segments."""

from __future__ import annotations

import attrs
import numpy as np
from ibrobot_kinematics import KinematicModel, Target, solve
from ibrobot_kinematics.rotations import from_quaternion

from ibrobot_core.api import Vector
from ibrobot_mujoco.policy_options import ScriptedPickOptions
from ibrobot_mujoco.trajectory import Limits, Segment, move, rest

SETTLE_S = 0.2
"""Pause after the gripper has closed or opened [s]."""
GRASP_TURN_RAD, HOVER_TURN_RAD = 0.35, 1.2
"""Allowed deviation of the gripper from vertical, if the arm cannot reach vertical [rad]."""


@attrs.frozen(eq=False)
class Scene:
    """The ground truth: positions [m] in the base frame, shape (3,); the cube's axes as columns, shape (3, 3)."""

    cube: Vector
    cube_axes: Vector
    bin: Vector

    @classmethod
    def parse(cls, values: Vector) -> Scene:
        """Parse an observation, shape (SCENE_SIZE,)."""
        return cls(values[:3], from_quaternion(np.roll(values[3:7], -1)), values[7:])


@attrs.frozen(eq=False)
class PickPlanner:
    """Plans with the robot's model; `gripper` is the index of the gripper's joint."""

    arm: KinematicModel
    options: ScriptedPickOptions
    limits: Limits
    gripper: int

    def plan(self, start: Vector, scene: Scene, home: Vector) -> list[Segment]:
        """The segments that pick the cube from `start`, put it into the bin, and go `home`; both shape (J,) [rad].

        Raises:
            UnreachableError: if the cube or the bin is out of reach.
        """
        opened, closed = self.options.gripper_open, self.options.gripper_closed
        above = scene.cube + np.array([0.0, 0.0, self.options.hover_height])
        down = _down(_heading(scene))
        hover = self._solve(above, down, start, opened, HOVER_TURN_RAD)
        grasp = self._solve(scene.cube, down, hover, opened, GRASP_TURN_RAD)
        over_bin = scene.bin + np.array([0.0, 0.0, self.options.release_height])
        release = self._solve(over_bin, _down(_inward(scene.bin)), hover, closed, HOVER_TURN_RAD)
        held, lifted, freed = self._at(grasp, closed), self._at(hover, closed), self._at(release, opened)
        return [
            move("hover", start, hover, self.limits),
            move("descend", hover, grasp, self.limits),
            move("close", grasp, held, self.limits),
            rest("close", held, SETTLE_S),
            move("lift", held, lifted, self.limits),
            move("carry", lifted, release, self.limits),
            move("open", release, freed, self.limits),
            rest("open", freed, SETTLE_S),
            move("return", freed, home, self.limits),
        ]

    def _solve(self, position: Vector, rotation: Vector, start: Vector, gripper: float, turn: float) -> Vector:
        joints = solve(self.arm, Target(position, rotation), start, rotation_tolerance=turn)
        return self._at(joints, gripper)

    def _at(self, joints: Vector, gripper: float) -> Vector:
        result = joints.copy()
        result[self.gripper] = gripper
        return result


def _inward(position: Vector) -> float:
    """Direction [rad] from `position`, shape (3,), to the base's origin, seen from above."""
    return float(np.arctan2(-position[1], -position[0]))


def _heading(scene: Scene) -> float:
    """Direction [rad] in which the jaws close: across two faces of the cube, as nearly inward as these allow."""
    across = scene.cube_axes[:2, np.argmin(np.abs(scene.cube_axes[2]))]
    face, inward = np.arctan2(across[1], across[0]), _inward(scene.cube)
    quarter = np.pi / 2
    return float(face + quarter * np.round((inward - face) / quarter))


def _down(heading: float) -> Vector:
    """Axes of a tip that points straight down and whose jaws close along `heading` [rad], shape (3, 3)."""
    return np.array(
        [
            [np.cos(heading), np.sin(heading), 0.0],
            [np.sin(heading), -np.cos(heading), 0.0],
            [0.0, 0.0, -1.0],
        ]
    )
