"""Teleop `webxr`: the tool follows a hand while its clutch is held."""

from __future__ import annotations

import math
from typing import override

import numpy as np
from ibrobot_kinematics import KinematicsError, Servo, TipPose, robot_model, world_clearance
from ibrobot_kinematics.rotations import exp, log

from ibrobot_core.api import (
    Context,
    Deadman,
    JointReading,
    Robot,
    Teleop,
    TeleopCommand,
    TeleopError,
    Vector,
    seconds,
)
from ibrobot_core.app import Bus
from ibrobot_webxr.exchange import Inbox, Sample
from ibrobot_webxr.hand import HandMotion
from ibrobot_webxr.options import HANDS, WebxrOptions
from ibrobot_webxr.server import PageServer
from ibrobot_webxr.shared import close_page, open_page

_LONGEST_STEP_S = 0.1
"""Longest motion of the gripper in one command [s]: after a pause of the host it does not jump."""
_LATE = 0.6
"""Share of the timeout after which the arm slows down; after all of it, it holds."""
_STOP_S = 0.045
"""Joint speeds are limited so that joints can stop within this time [s]: the arm stands 0.1 s after the last pose."""
_LEAD_M, _LEAD_RAD = 0.1, 0.5
"""How far the hand may be ahead of a tool that cannot follow. Beyond it the hand slips, so that the tool
follows at once when the hand returns."""
_BRAKING, _TURN_BRAKING = 2.0, 10.0
"""Deceleration of the tool towards the pose of the hand [m/s² and rad/s²]."""
_ARRIVED = 1e-5, 1e-4
"""Distance from the pose of the hand that counts as arrived [m and rad]."""
_TRIGGER = 0.1
"""The gripper moves once the trigger has moved this far."""
_FULL = 6
"""Joints that an arm needs to reach any pose. With fewer, rotation about the tip's x axis is left free."""


class WebxrTeleop(Teleop):
    """Moves the tool as the hand moves while the clutch is held, from where both are when it is pressed.

    When a hand is lost, or its poses come too late, the robot holds. The clutch must then be released and pressed
    again.
    """

    def __init__(self, options: WebxrOptions, ctx: Context) -> None:
        robot = ctx.robot
        self._options = options
        self._ctx = ctx
        gripper = robot.groups.get(options.gripper, ())
        arm = tuple(name for name in robot.joint_names if name not in gripper)
        self._joints = (*arm, *gripper)
        self._indices = robot.indices(self._joints)
        self._hands = HANDS if options.hand == "any" else (options.hand,)
        self._page: PageServer | None = None
        self._inbox: Inbox | None = None
        self._tool = _Tool(options, robot, arm)
        self._gripper = _Gripper(options, robot, gripper)
        self._restart()

    def _restart(self) -> None:
        self._clutches = {hand: _Clutch(self._options.timeout) for hand in self._hands}
        self._engaged: str | None = None
        """The hand that moves the robot."""
        self._setpoint: Vector | None = None
        """The last setpoints [rad], in the order of `_joints`."""
        self._stamp_ns = 0

    @override
    def connect(self) -> None:
        if self._page is None:
            self._tool.load(self._ctx.name, self._ctx.bus)
            self._page = open_page(self._options, self._ctx)
            self._inbox = self._page.exchange.join(self._hands)
            self._restart()

    @override
    def activate(self, measured: JointReading) -> None:
        if self._page is not None and self._inbox is not None:
            # Discard what was pressed before. The server itself passes an emergency stop to control.
            self._inbox.drain()
            self._page.exchange.take_events()
        self._restart()

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if self._page is None or self._inbox is None:
            raise TeleopError(f"{self._ctx.name}: the page is not served: call connect before read")
        exchange = self._page.exchange
        events, stop = exchange.take_events()
        now_ns = self._ctx.clock.now_ns()
        here = measured.position[self._indices]
        for hand, sample in self._inbox.drain():
            self._take(hand, sample, now_ns, here)
        engaged = self._engaged
        held = {hand: clutch.holds(now_ns) for hand, clutch in self._clutches.items()}
        if engaged is not None and (stop or not held[engaged] or not np.isfinite(here).all()):
            self._engaged = None
        if stop:
            self._clutches = {hand: _Clutch(self._options.timeout) for hand in self._hands}
        exchange.report(self._hands, self._ctx.name, self._engaged, self._hint())
        if self._setpoint is None or stop:
            return TeleopCommand(None, estop=stop, events=events)
        dt = min(max(seconds(measured.stamp_ns - self._stamp_ns), 0.0), _LONGEST_STEP_S)
        self._stamp_ns = measured.stamp_ns
        count = len(self._tool.joints)
        gripper = self._setpoint[count:]
        if self._engaged is not None:
            newest = self._clutches[self._engaged].sample
            assert newest is not None
            is_late = newest.age_s(now_ns) > _LATE * self._options.timeout
            arm = (self._tool.brake if is_late else self._tool.follow)(measured.stamp_ns, here[:count])
            gripper = self._gripper.follow(newest, here[count:], dt)
        elif self._tool.moves and np.isfinite(here).all():
            arm = self._tool.brake(measured.stamp_ns, here[:count])
        else:
            return TeleopCommand(None, events=events)
        self._setpoint = np.concatenate([arm, gripper])
        return TeleopCommand(dict(zip(self._joints, self._setpoint.tolist(), strict=True)), events=events)

    @override
    def disconnect(self) -> None:
        if self._page is not None and self._inbox is not None:
            self._page.exchange.leave(self._inbox)
            close_page(self._options, self._ctx)
        self._page = self._inbox = None

    @override
    def help(self) -> str:
        where = "not served" if self._page is None else self._page.address
        return f"page for a phone or headset: {where}\nhold the clutch to move; the page has the other controls"

    def _take(self, hand: str, sample: Sample, now_ns: int, here: Vector) -> None:
        """Process a sample of a hand."""
        clutch = self._clutches[hand]
        presses = clutch.take(sample, now_ns)
        if sample.pose is not None:
            self.deadman.report(any(each.is_held for each in self._clutches.values()), sample.made_ns)
        if self._engaged == hand and (presses or not clutch.pressed):
            self._engaged = None
        if presses and self._engaged is None and np.isfinite(here).all():
            self._engage(hand, sample, here)
        elif self._engaged == hand and sample.pose is not None:
            self._tool.motion.update(sample.pose, sample.time_s)

    def _engage(self, hand: str, sample: Sample, here: Vector) -> None:
        """Begin to follow a hand, from where the robot is."""
        assert sample.pose is not None
        count = len(self._tool.joints)
        before = here if self._setpoint is None else self._setpoint
        # The robot sags a little from its last setpoint: starting from the setpoint causes no jump.
        moved = np.abs(before[:count] - here[:count]).max(initial=0.0) > self._options.follow
        arm = here[:count] if moved else before[:count]
        gripper = self._gripper.engage(before[count:], here[count:], sample.pose.gripper)
        self._tool.engage(arm, sample)
        self._setpoint = np.concatenate([arm, gripper])
        self._engaged = hand

    def _hint(self) -> str:
        """A hint for the operator; empty if there is nothing to do."""
        if self._engaged is not None:
            return ""
        tracked = [clutch for clutch in self._clutches.values() if not clutch.is_lost]
        if not tracked:
            return "the hand is not tracked, or the network is slow"
        return "release the clutch and press it again" if any(clutch.is_stuck for clutch in tracked) else ""


class _Clutch:
    """The clutch of one hand, as a deadman of its own.

    Attributes:
        sample: the newest usable sample.
        pressed: whether it is held, and moves the robot.
        is_lost: whether the newest sample is too old.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._deadman = Deadman()
        self.sample: Sample | None = None
        self.pressed = False
        self.is_lost = True

    def take(self, sample: Sample, now_ns: int) -> bool:
        """Take a sample; returns whether it presses the clutch. Samples without a tracked hand are ignored."""
        if sample.pose is None or sample.age_s(now_ns) > self._timeout_s:
            return False
        if self.sample is not None and (sample.made_ns - self.sample.made_ns) * 1e-9 > self._timeout_s:
            self._deadman.disarm(sample.made_ns - 1)
        self.sample = sample
        before = self.pressed
        self._deadman.report(sample.pose.clutch, sample.made_ns)
        return self.holds(now_ns) and not before

    def holds(self, now_ns: int) -> bool:
        """Whether a recent sample has it held."""
        self.is_lost = self.sample is None or self.sample.age_s(now_ns) > self._timeout_s
        if self.is_lost:
            self._deadman.disarm(now_ns)
        self.pressed = self._deadman.allows(now_ns)
        return self.pressed

    @property
    def is_held(self) -> bool:
        """Whether its newest sample has it pressed."""
        return self.sample is not None and self.sample.pose is not None and self.sample.pose.clutch

    @property
    def is_stuck(self) -> bool:
        """Whether it is held without effect, until it is released."""
        return self.is_held and not self.pressed


class _Tool:
    """The arm: its tool follows the hand.

    Args:
        options: speeds and filter.
        robot: the robot.
        joints: names of the arm's joints.

    Attributes:
        joints: names of the arm's joints.
        motion: the motion of the hand.
    """

    def __init__(self, options: WebxrOptions, robot: Robot, joints: tuple[str, ...]) -> None:
        self._options = options
        self._robot = robot
        self._indices = robot.indices(joints)
        self._servo: Servo | None = None
        self._is_full = True
        self._origin: TipPose | None = None
        """Pose of the tool when the clutch engaged, adjusted when the tool cannot follow the hand."""
        self.joints = joints
        self.motion = HandMotion(options)

    def load(self, device: str, bus: Bus | None) -> None:
        """Load the model of the arm. The tool slows down near obstacles of the world of a run with this bus.

        Raises:
            TeleopError: if the robot has none, or it does not fit.
        """
        robot = self._robot
        if robot.description.mjcf is None:
            raise TeleopError(f"{device}: a hand moves the tool, which needs robot.description.mjcf: set it")
        try:
            model = robot_model(robot, self.joints)
        except KinematicsError as error:
            raise TeleopError(f"{device}: {error}") from error
        self._is_full = len(model.moving) >= _FULL
        max_acceleration = robot.max_acceleration[self._indices]
        max_velocity = np.minimum(robot.max_velocity[self._indices], _STOP_S * max_acceleration)
        self._servo = Servo(model, max_velocity, max_acceleration, clearance=world_clearance(bus, self.joints))

    def engage(self, position: Vector, sample: Sample) -> None:
        """Start at positions of the joints [rad], with the hand at a sample."""
        assert self._servo is not None
        assert sample.pose is not None
        self._servo.reset(position)
        self._origin = self._servo.tip()
        self.motion.engage(sample.pose, sample.heading, sample.time_s)

    def follow(self, now_ns: int, here: Vector) -> Vector:
        """Setpoints [rad] at the time of the measured positions `here` [rad]."""
        servo, origin, options = self._servo, self._origin, self._options
        assert servo is not None
        assert origin is not None
        tip = servo.tip()
        turned = self.motion.turned if options.turn else np.eye(3)
        way = origin.position + self.motion.moved - tip.position
        turn = log(turned @ origin.rotation @ tip.rotation.T)
        if not self._is_full:
            heading = tip.rotation[:, 0]
            turn = turn - (turn @ heading) * heading
        way, turn = _shortened(way, _LEAD_M), _shortened(turn, _LEAD_RAD)
        self._origin = TipPose(tip.position + way - self.motion.moved, turned.T @ exp(turn) @ tip.rotation)
        if np.linalg.norm(way) > _ARRIVED[0] or np.linalg.norm(turn) > _ARRIVED[1]:
            linear = _approach(way, options.follow_time, options.tool_speed, _BRAKING)
            angular = _approach(turn, options.follow_time, options.turn_speed, _TURN_BRAKING)
            servo.command(linear, angular, now_ns)
        else:
            servo.halt()
        return self._next(now_ns, here)

    @property
    def moves(self) -> bool:
        """Whether the last setpoints moved the arm."""
        return self._servo is not None and bool(self._servo.velocity.any())

    def brake(self, now_ns: int, here: Vector) -> Vector:
        """Setpoints [rad] on the way to a stop, at the time of the measured positions `here` [rad]."""
        assert self._servo is not None
        self._servo.halt()
        return self._next(now_ns, here)

    def _next(self, now_ns: int, here: Vector) -> Vector:
        servo = self._servo
        assert servo is not None
        position = servo.step(now_ns)
        lead = self._robot.max_lead[self._indices]
        if (np.abs(position - here) > lead).any():
            # A joint does not follow: the tool waits for it.
            position = np.clip(position, here - lead, here + lead)
            servo.hold_at(position)
        return position


class _Gripper:
    """The gripper, which a trigger closes in proportion, or buttons move.

    Args:
        options: its speed.
        robot: the robot.
        joints: names of its joints; empty if the robot has none.
    """

    def __init__(self, options: WebxrOptions, robot: Robot, joints: tuple[str, ...]) -> None:
        indices = robot.indices(joints)
        self._lower, self._upper = robot.lower[indices], robot.upper[indices]
        self._lead = robot.max_lead[indices]
        self._speed = np.minimum(options.gripper_speed, robot.max_velocity[indices])
        self._setpoint = np.zeros(len(joints))
        self._rest: float | None = None
        """Trigger when the clutch engaged, until it moves: the gripper does not drop its object."""

    def engage(self, before: Vector, here: Vector, trigger: float | None) -> Vector:
        """Start from the last setpoints, which squeeze an object, or from the measured positions [rad]."""
        self._setpoint = np.where(np.abs(before - here) <= self._lead, before, here)
        self._rest = trigger
        return self._setpoint.copy()

    def follow(self, sample: Sample, here: Vector, dt: float) -> Vector:
        """Setpoints [rad] after `dt` [s], with the joints at `here` [rad]."""
        pose = sample.pose
        assert pose is not None
        trigger = pose.gripper
        if self._rest is not None and trigger is not None and abs(trigger - self._rest) > _TRIGGER:
            self._rest = None
        wanted = self._setpoint
        if pose.open:
            wanted = self._upper if pose.open > 0 else self._lower
        elif trigger is not None and self._rest is None:
            wanted = self._upper - trigger * (self._upper - self._lower)
        step = self._speed * dt * (abs(pose.open) if pose.open else 1.0)
        after = self._setpoint + np.clip(wanted - self._setpoint, -step, step)
        self._setpoint = np.clip(after, here - self._lead, here + self._lead)
        return self._setpoint.copy()


def _shortened(vector: Vector, most: float) -> Vector:
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)


def _approach(way: Vector, time_s: float, speed: float, braking: float) -> Vector:
    """Velocity along `way` to its end: exponential when near, and slow enough to brake when far."""
    length = float(np.linalg.norm(way))
    if length == 0:
        return way
    return way * (min(length / time_s, math.sqrt(2 * braking * length), speed) / length)
