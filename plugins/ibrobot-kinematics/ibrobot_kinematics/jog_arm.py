"""Jog of a robot's arm and gripper, shared by keyboards, gamepads and other jog devices."""

from __future__ import annotations

import attrs
import numpy as np

from ibrobot_core.api import JointReading, Robot, TeleopError, Vector, ns, seconds
from ibrobot_core.app import Bus
from ibrobot_kinematics.clearance import world_clearance
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import robot_model
from ibrobot_kinematics.servo import Servo

_LEVER_M = 0.1
"""Length that corresponds to one radian when twists are compared [m]."""

_LONGEST_STEP_S = 0.1
"""Longest step of a jog [s]: after a pause of the host the robot does not jump."""


class JogArm:
    """Computes the next setpoints of a robot, within the limits and speeds of its joints.

    All joint vectors are in the robot's order. A joint outside its limits may move inwards; no joint moves outwards.

    Args:
        robot: the robot.
        gripper: name of the gripper's group of joints; all other joints are the arm.

    Attributes:
        robot: the robot.
        arm: names of the arm's joints.
        gripper: names of the gripper's joints; empty if the robot lacks the group.
    """

    def __init__(self, robot: Robot, gripper: str) -> None:
        self.robot = robot
        self.gripper = robot.groups.get(gripper, ())
        self.arm = tuple(name for name in robot.joint_names if name not in self.gripper)
        self._servo: Servo | None = None
        self._now_ns = 0
        """The sum of the steps in which the tool moved [ns]."""

    def load_model(self, remedy: str, bus: Bus | None) -> None:
        """Load the model that `move_tool` needs.

        Args:
            remedy: the setting that needs no model, for the error, e.g. `cartesian: false`.
            bus: the bus of the run; the tool slows down near obstacles of its world. None without a run.

        Raises:
            TeleopError: if the robot has no model of its arm, or one that does not fit.
        """
        if self.robot.description.mjcf is None:
            raise TeleopError(f"Cartesian jog needs robot.description.mjcf: set it, or {remedy}")
        try:
            model = robot_model(self.robot, self.arm)
        except KinematicsError as error:
            raise TeleopError(f"Cartesian jog: {error}; set {remedy} to do without it") from error
        arm = self.robot.indices(self.arm)
        self._servo = Servo(
            model,
            self.robot.max_velocity[arm],
            self.robot.max_acceleration[arm],
            clearance=world_clearance(bus, self.arm),
        )

    @property
    def tool_moves(self) -> bool:
        """Whether the tool still moves after `move_tool`; zero velocities slow it down to a stop."""
        return self._servo is not None and bool(self._servo.velocity.any())

    def stop_tool(self) -> None:
        """Assume that the tool is at rest, e.g. because another component holds the arm."""
        if self._servo is not None:
            self._servo.reset(self._servo.position)

    def move_joints(self, before: Vector, velocity: Vector, dt: float) -> Vector:
        """Setpoints `dt` [s] after `before` [rad], shape (J,), at a velocity [rad/s], shape (J,)."""
        most = self.robot.max_velocity
        return self._bounded(before, before + np.clip(velocity, -most, most) * dt)

    def move_towards(self, before: Vector, pose: Vector, speed: float, dt: float) -> Vector:
        """Setpoints `dt` [s] after `before` on the straight line to `pose`, both [rad], shape (J,).

        Args:
            before: the last setpoints.
            pose: the target positions.
            speed: speed of the joints [rad/s].
            dt: the step [s].
        """
        way = pose - before
        reach = np.minimum(speed, self.robot.max_velocity) * dt
        share = min(1.0, float(np.min(reach / np.maximum(np.abs(way), 1e-9))))
        return self._bounded(before, before + share * way)

    def move_tool(self, before: Vector, linear: Vector, turn: Vector, dt: float) -> Vector:
        """Setpoints `dt` [s] after `before`, both [rad], shape (J,), while the tool moves as with `Servo`.

        Args:
            before: the last setpoints. If they differ from the result of the last call, the tool starts there at rest.
            linear: velocity of the tool in the base frame [m/s], shape (3,).
            turn: angular velocity about the tool's own axes [rad/s], shape (3,). The tool points along z:
                roll turns about z, pitch about y. The arm holds the heading, about x, as well as it can.
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
    """The motion that a device requests at one instant."""

    velocity: Vector
    """Of each joint [rad/s], shape (J,); ignored for the arm's joints while the tool moves."""
    linear: Vector = attrs.field(factory=lambda: np.zeros(3))
    """Of the tool, as `JogArm.move_tool` takes it."""
    turn: Vector = attrs.field(factory=lambda: np.zeros(3))
    """Of the tool, as `JogArm.move_tool` takes it."""
    pose: Vector | None = None
    """Target of all joints, in place of velocities [rad], shape (J,)."""
    pose_speed: float = 0.0
    """Speed towards the target [rad/s]."""

    @property
    def is_rest(self) -> bool:
        """Whether it requests no motion."""
        return self.pose is None and not (self.velocity.any() or self.linear.any() or self.turn.any())


class VelocityJog:
    """Integrates the velocities of a jog device into setpoints.

    - Joints at rest keep their setpoint while the robot is within `follow` of it. Beyond, the setpoint follows the
      robot, so an arm that a person pushes away does not spring back.
    - A joint that reverses starts from the measured position, so the operator does not wait for the lead to shrink.
    - No setpoint is further from the measured position than `Joint.max_lead`. The tool waits before a joint of the arm
      exceeds it.

    Args:
        arm: the robot.
        follow: how far a joint at rest may be from its setpoint [rad]; must exceed its sag, or the joint creeps.
    """

    def __init__(self, arm: JogArm, follow: float) -> None:
        self._arm = arm
        self._follow = follow
        self._setpoint: Vector | None = None
        self._direction = np.zeros(len(arm.robot.joints))
        self._twist = np.zeros(6)
        self._moved_ns: int | None = None
        """Time of the last step [ns]; None at rest."""

    def restart(self, measured: Vector) -> None:
        """Begin from the measured positions [rad], shape (J,)."""
        self._setpoint = measured.copy()
        self._direction[:] = 0.0
        self._twist[:] = 0.0
        self._arm.stop_tool()

    @property
    def setpoint(self) -> Vector:
        """The last setpoints [rad], shape (J,); after a `step` from rest, the measured positions."""
        assert self._setpoint is not None
        return self._setpoint

    def rest(self) -> None:
        """Command nothing: the next `step` begins from the measured positions."""
        self._moved_ns = None

    def step(self, measured: JointReading) -> float:
        """Begin a step at the time of a measurement; returns its length [s], for `move`: 0 from rest, at most 0.1 s."""
        before_ns, self._moved_ns = self._moved_ns, measured.stamp_ns
        if before_ns is None:
            self.restart(measured.position)
            return 0.0
        return min(max(seconds(measured.stamp_ns - before_ns), 0.0), _LONGEST_STEP_S)

    def move(self, measured: Vector, motion: JogMotion, dt: float) -> Vector:
        """The setpoints after a motion of `dt` [s], shape (J,).

        Args:
            measured: positions of the joints [rad], shape (J,).
            motion: the motion that the device requests.
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
