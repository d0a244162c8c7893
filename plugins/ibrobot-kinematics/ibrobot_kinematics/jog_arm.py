"""A robot whose arm and gripper are jogged: what keyboards, gamepads and other jog devices have in common."""

from __future__ import annotations

import attrs
import numpy as np

from ibrobot_core.api import Robot, TeleopError, Vector, ns
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import robot_model
from ibrobot_kinematics.servo import Servo

_LEVER_M = 0.1
"""Where twists are compared, a turn of one radian counts as this way [m]."""


class JogArm:
    """Where the joints of a robot go from their setpoints, within the limits and speeds of its joints.

    All vectors of joints are in the robot's order. An arm that rests outside its limits may come in; no joint goes out.

    Args:
        robot: the robot.
        gripper: its group of joints that is the gripper; all other joints are the arm.

    Attributes:
        robot: the robot.
        arm: names of the arm's joints.
        gripper: names of the gripper's joints; none where the robot lacks the group.
    """

    def __init__(self, robot: Robot, gripper: str) -> None:
        self.robot = robot
        self.gripper = robot.groups.get(gripper, ())
        self.arm = tuple(name for name in robot.joint_names if name not in self.gripper)
        self._servo: Servo | None = None
        self._now_ns = 0
        """The sum of the steps in which the tool moved [ns]."""

    def load_model(self, remedy: str) -> None:
        """Load what `move_tool` needs.

        Args:
            remedy: how to do without it, e.g. `cartesian: false`, for the error.

        Raises:
            TeleopError: where the robot has no model of its arm, or one that does not fit.
        """
        if self.robot.description.mjcf is None:
            raise TeleopError(f"Cartesian jog needs robot.description.mjcf: set it, or {remedy}")
        try:
            model = robot_model(self.robot, self.arm)
        except KinematicsError as error:
            raise TeleopError(f"Cartesian jog: {error}; set {remedy} to do without it") from error
        arm = self.robot.indices(self.arm)
        self._servo = Servo(model, self.robot.max_velocity[arm], self.robot.max_acceleration[arm])

    @property
    def tool_moves(self) -> bool:
        """Whether the tool has a velocity from `move_tool`; no twist slows it down to a stop."""
        return self._servo is not None and bool(self._servo.velocity.any())

    def stop_tool(self) -> None:
        """Take the tool to be at rest, e.g. since something else holds the arm."""
        if self._servo is not None:
            self._servo.reset(self._servo.position)

    def move_joints(self, before: Vector, velocity: Vector, dt: float) -> Vector:
        """Setpoints `dt` [s] after `before` [rad], shape (J,), at a velocity [rad/s], shape (J,)."""
        most = self.robot.max_velocity
        return self._bounded(before, before + np.clip(velocity, -most, most) * dt)

    def move_towards(self, before: Vector, pose: Vector, speed: float, dt: float) -> Vector:
        """Setpoints `dt` [s] after `before` on the straight way to `pose`, both [rad], shape (J,), all joints in step.

        Args:
            before: the setpoints before.
            pose: where to go.
            speed: of the joints [rad/s].
            dt: the step [s].
        """
        way = pose - before
        reach = np.minimum(speed, self.robot.max_velocity) * dt
        share = min(1.0, float(np.min(reach / np.maximum(np.abs(way), 1e-9))))
        return self._bounded(before, before + share * way)

    def move_tool(self, before: Vector, linear: Vector, turn: Vector, dt: float) -> Vector:
        """Setpoints `dt` [s] after `before`, both [rad], shape (J,), where the tool moves, as `Servo` moves it.

        Args:
            before: the setpoints before. Where they are not those of the last call, the tool begins at rest there.
            linear: velocity of the tool in the base frame [m/s], shape (3,).
            turn: angular velocity about the tool's own axes [rad/s], shape (3,). The z axis is where the tool points:
                roll turns about it, pitch about y, and the heading, about x, is held as well as the arm can.
            dt: the step [s].

        Raises:
            TeleopError: before `load_model`.
        """
        servo = self._servo
        if servo is None:
            raise TeleopError("the model of the arm is not loaded: call load_model before move_tool")
        arm = self.robot.indices(self.arm)
        if not np.array_equal(before[arm], servo.position):
            servo.reset(before[arm])
        servo.step(self._now_ns)
        if linear.any() or turn.any():
            servo.command(linear, servo.tip().rotation @ turn, self._now_ns)
        else:
            servo.halt()
        self._now_ns += ns(dt)
        after = before.copy()
        after[arm] = servo.step(self._now_ns)
        return self._bounded(before, after)

    def _bounded(self, before: Vector, after: Vector) -> Vector:
        return np.clip(after, np.minimum(self.robot.lower, before), np.maximum(self.robot.upper, before))


@attrs.frozen
class JogMotion:
    """What a device asks for at one instant."""

    velocity: Vector
    """Of each joint [rad/s], shape (J,); not of the arm's where the tool moves."""
    linear: Vector = attrs.field(factory=lambda: np.zeros(3))
    """Of the tool, as `JogArm.move_tool` takes it."""
    turn: Vector = attrs.field(factory=lambda: np.zeros(3))
    """Of the tool, as `JogArm.move_tool` takes it."""
    pose: Vector | None = None
    """Where all joints go instead [rad], shape (J,)."""
    pose_speed: float = 0.0
    """How fast they go there [rad/s]."""


class VelocityJog:
    """Integrates the velocities of a jog device into setpoints.

    - Joints at rest keep their setpoint while the robot is within `follow` of it, and follow the robot beyond: an arm
      that a person pushes away does not spring back.
    - What reverses starts over from the measured position: the operator does not wait until a lead is used up.
    - No setpoint is further from the measured position than `Joint.max_lead`. Where a joint of the arm would be, the
      tool waits.

    Args:
        arm: the robot.
        follow: how far a joint at rest may be from its setpoint [rad]; more than it sags under load, or it creeps.
    """

    def __init__(self, arm: JogArm, follow: float) -> None:
        self._arm = arm
        self._follow = follow
        self._setpoint: Vector | None = None
        self._direction = np.zeros(len(arm.robot.joints))
        self._twist = np.zeros(6)

    def restart(self, measured: Vector) -> None:
        """Begin from the measured positions [rad], shape (J,)."""
        self._setpoint = measured.copy()
        self._direction[:] = 0.0
        self._twist[:] = 0.0
        self._arm.stop_tool()

    def move(self, measured: Vector, motion: JogMotion, dt: float) -> Vector:
        """The setpoints after a motion of `dt` [s], shape (J,).

        Args:
            measured: positions of the joints [rad], shape (J,).
            motion: what the device asks for.
            dt: the step [s].
        """
        if self._setpoint is None:
            self.restart(measured)
        assert self._setpoint is not None
        arm = self._arm.robot.indices(self._arm.arm)
        twist = np.concatenate([motion.linear, _LEVER_M * motion.turn])
        turns_tool = bool(twist.any()) or self._arm.tool_moves
        fresh = motion.velocity * self._direction < 0
        moving = motion.velocity != 0
        self._direction = np.where(moving, np.sign(motion.velocity), self._direction)
        if turns_tool:
            fresh[arm] |= bool(twist @ self._twist < 0)
            moving[arm] = True
            if twist.any():
                self._twist = twist
        if motion.pose is not None:
            moving[:] = True
        rest = np.clip(self._setpoint, measured - self._follow, measured + self._follow)
        start = np.where(fresh, measured, np.where(moving, self._setpoint, rest))
        lead = self._arm.robot.max_lead
        if motion.pose is not None:
            after = self._arm.move_towards(start, motion.pose, motion.pose_speed, dt)
        elif turns_tool:
            after = self._arm.move_tool(start, motion.linear, motion.turn, dt)
            ahead = np.abs(after - measured)
            if np.any((ahead > lead) & (ahead > np.abs(start - measured))):
                after = start
        else:
            after = start
        after = self._arm.move_joints(after, motion.velocity, dt)
        self._setpoint = np.clip(after, measured - lead, measured + lead)
        return self._setpoint.copy()
