"""Cartesian jog: differential inverse kinematics of the arm, a small step of the tool at a time."""

from __future__ import annotations

from collections.abc import Sequence

import mink
import mujoco
import numpy as np

from ibrobot_core.errors import TeleopError
from ibrobot_core.robot import Robot, Vector

_LEVER_M = 0.1
"""Turning the tool by a radian weighs as much as moving it by this [m]."""
_YAW_SHARE = 0.05
"""Weight of holding the heading, relative to the other turns: an arm of five joints cannot, one of six can."""
_MOST_MISSED = 0.5
"""Share of a step by which the tool may miss its target; where it would miss by more, the reach ends and it stays."""
_DAMPING = 1e-7


class CartesianJog:
    """Moves the tip of the robot's MJCF model.

    The tip's z axis is where the tool points: roll turns about it, pitch about the tip's y axis, and the heading, about
    its x axis, is held as well as the arm can.

    Args:
        robot: its description names the MJCF and the tip, a site of it.
        joints: the joints that may move.

    Raises:
        TeleopError: when there is no MJCF, or it lacks the tip or one of the joints.
    """

    def __init__(self, robot: Robot, joints: Sequence[str]) -> None:
        self._order = robot.indices(joints)
        self._lower, self._upper = robot.lower[self._order], robot.upper[self._order]
        self._tip = robot.description.tip
        model = _model(robot)
        self._address = np.array([model.joint(name).qposadr[0] for name in joints])
        moving = {int(model.joint(name).dofadr[0]) for name in joints}
        model.jnt_limited[:] = False
        for name, lower, upper in zip(joints, self._lower, self._upper, strict=True):
            model.joint(name).range = lower, upper
            model.jnt_limited[model.joint(name).id] = True
        self._configuration = mink.Configuration(model)
        turns = np.array([_YAW_SHARE, 1.0, 1.0]) * _LEVER_M
        self._task = mink.FrameTask(self._tip, "site", position_cost=1.0, orientation_cost=turns)
        speeds = dict(zip(joints, robot.max_velocity[self._order], strict=True))
        self._limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
        frozen = [dof for dof in range(model.nv) if dof not in moving]
        self._constraints = [mink.DofFreezingTask(model, frozen)] if frozen else None

    def step(self, positions: Vector, move: Vector, turn: Vector, dt: float) -> Vector:
        """Where the joints go in one small step.

        Args:
            positions: where they are [rad], shape (J,), in robot order.
            move: velocity of the tip in the base frame [m/s], shape (3,).
            turn: speeds of pitch and roll [rad/s], shape (2,).
            dt: the step [s], above zero.

        Returns:
            New positions [rad], shape (J,); the old ones where the tool cannot go on in this direction.
        """
        q = self._configuration.q.copy()
        q[self._address] = start = np.clip(positions[self._order], self._lower, self._upper)
        self._configuration.update(q)
        pose = self._pose()
        # From where the tool is and not from the last target: what a limit took away must not come back later.
        target = mink.SE3.from_rotation_and_translation(
            pose.rotation() @ mink.SO3.exp(np.array([0.0, *turn]) * dt), pose.translation() + move * dt
        )
        self._task.set_target(target)
        try:
            velocity = mink.solve_ik(
                self._configuration,
                [self._task],
                dt,
                "daqp",
                _DAMPING,
                limits=self._limits,
                constraints=self._constraints,
            )
        except mink.NoSolutionFound:
            return positions
        q = self._configuration.integrate(velocity, dt)
        self._configuration.update(q)
        reached = self._pose()
        missed = np.append(
            reached.translation() - target.translation(),
            _LEVER_M * (target.rotation().inverse() @ reached.rotation()).log()[1:],
        )
        asked = np.append(move, _LEVER_M * turn) * dt
        if np.linalg.norm(missed) > _MOST_MISSED * np.linalg.norm(asked):
            return positions
        moved = positions.copy()
        moved[self._order] += q[self._address] - start
        return moved

    def _pose(self) -> mink.SE3:
        return self._configuration.get_transform_frame_to_world(self._tip, "site")


def _model(robot: Robot) -> mujoco.MjModel:
    """The robot's bodies, joints and sites, without their shapes, which take a second to load and move nothing."""
    path = robot.description.mjcf
    if path is None:
        raise TeleopError("Cartesian jog needs robot.description.mjcf: set it, or cartesian: false")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for shape in (*spec.geoms, *spec.meshes):
            spec.delete(shape)
        # Bodies that got their mass from their shapes are left without; kinematics asks for none, the compiler does.
        spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6
        model = spec.compile()
    except ValueError as error:
        raise TeleopError(f"robot.description.mjcf: {path} cannot be loaded: {error}") from error
    sites = [model.site(i).name for i in range(model.nsite)]
    if robot.description.tip not in sites:
        raise TeleopError(
            f"robot.description.tip: {path} has no site {robot.description.tip!r}; it has: {', '.join(sites)}"
        )
    names = [model.joint(i).name for i in range(model.njnt)]
    for joint in robot.joint_names:
        if joint not in names:
            raise TeleopError(f"{path} has no joint {joint!r}; it has: {', '.join(names)}")
    return model
