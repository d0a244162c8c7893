"""Inverse kinematics: a thin wrapper around mink that gives joint positions for a pose of the robot's tip."""

from __future__ import annotations

import attrs
import mink
import mujoco
import numpy as np

from ibrobot_core.errors import PlanningError
from ibrobot_core.robot import Robot, Vector

ITERATIONS = 60
CONVERGED_RAD = 1e-4
"""A step of no joint beyond this ends the search."""
POSITION_TOLERANCE_M = 1e-3
LIMIT_MARGIN_RAD = 1e-3


@attrs.frozen(eq=False)
class TipPose:
    """Where the tip is, in the base frame: its origin [m], shape (3,), and its axes as columns, shape (3, 3)."""

    position: Vector
    rotation: Vector


class InverseKinematics:
    """Damped least squares within the joint limits, as quadratic programs; deterministic.

    Args:
        robot: its joints' limits bound every solution; its description names the MJCF and the tip, a site of it.

    Raises:
        PlanningError: when there is no MJCF, or it lacks one of the joints or the tip.
    """

    def __init__(self, robot: Robot) -> None:
        self._model = _kinematic_model(robot)
        self._tip = robot.description.tip
        self._joints = np.array([self._model.joint(name).qposadr[0] for name in robot.joint_names])
        ranges = np.array([self._model.joint(name).range for name in robot.joint_names])
        self._lower, self._upper = ranges[:, 0] + LIMIT_MARGIN_RAD, ranges[:, 1] - LIMIT_MARGIN_RAD
        self._configuration = mink.Configuration(self._model)
        # A centimetre weighs as much as a radian: where both cannot be had the position is, and the orientation nearly.
        self._task = mink.FrameTask(self._tip, "site", position_cost=100.0, orientation_cost=1.0, lm_damping=1.0)
        self._limits = [mink.ConfigurationLimit(self._model, gain=1.0, min_distance_from_limits=LIMIT_MARGIN_RAD)]

    def forward(self, joints: Vector) -> TipPose:
        """The tip's pose at `joints` [rad], shape (J,)."""
        self._place(joints)
        site = self._configuration.data.site(self._tip)
        return TipPose(site.xpos.copy(), site.xmat.reshape(3, 3).copy())

    def solve(self, target: TipPose, start: Vector, *, orientation_tolerance: float = 0.01) -> Vector:
        """Joint positions [rad], shape (J,), that bring the tip to `target`.

        Joints that do not move the tip (the gripper's jaw) stay where the search began.

        Args:
            target: where to bring the tip.
            start: where the search begins, shape (J,); it begins again in the middle of the limits where that fails.
            orientation_tolerance: how far [rad] the tip may turn away from `target` where the arm cannot do better.

        Raises:
            PlanningError: when the target is out of reach.
        """
        rotation = mink.SO3.from_matrix(target.rotation)
        self._task.set_target(mink.SE3.from_rotation_and_translation(rotation, target.position))
        for begin in (start, (self._lower + self._upper) / 2):
            self._descend(begin)
            error = self._task.compute_error(self._configuration)
            off, turned = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
            if off <= POSITION_TOLERANCE_M and turned <= orientation_tolerance:
                return np.asarray(self._configuration.q[self._joints])
        x, y, z = target.position
        raise PlanningError(
            f"{self._tip} cannot reach ({x:.3f}, {y:.3f}, {z:.3f}) m as asked within the joint limits;"
            f" the nearest found is {1000 * off:.0f} mm and {np.degrees(turned):.0f} degrees off"
        )

    def _descend(self, start: Vector) -> None:
        """Bring the configuration from `start` as near to the task's target as it gets."""
        self._place(np.clip(start, self._lower, self._upper))
        for _ in range(ITERATIONS):
            step = mink.solve_ik(self._configuration, [self._task], 1.0, "daqp", damping=1e-9, limits=self._limits)
            self._configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < CONVERGED_RAD:
                return

    def _place(self, joints: Vector) -> None:
        q = self._configuration.q
        q[self._joints] = joints
        self._configuration.update(q)


def _kinematic_model(robot: Robot) -> mujoco.MjModel:
    """The MJCF within the robot's limits and without its geometry, which takes a second to load and moves nothing."""
    mjcf = robot.description.mjcf
    if mjcf is None:
        raise PlanningError(f"robot {robot.name!r} has no description.mjcf; inverse kinematics needs a MuJoCo model")
    spec = mujoco.MjSpec.from_file(str(mjcf))
    for element in (*spec.geoms, *spec.meshes):
        spec.delete(element)
    named = {"site": [site.name for site in spec.sites], "joint": [joint.name for joint in spec.joints]}
    for kind, name in [("site", robot.description.tip), *(("joint", name) for name in robot.joint_names)]:
        if name not in named[kind]:
            raise PlanningError(f"{mjcf} has no {kind} {name!r}; it has: {', '.join(named[kind])}")
    model = spec.compile()
    for joint in robot.joints:
        lower, upper = model.joint(joint.name).range
        model.joint(joint.name).range = max(lower, joint.lower), min(upper, joint.upper)
    return model
