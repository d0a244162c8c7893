"""Teleop `twist`: moves the tool along a topic of twists."""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import override

import numpy as np

from ibrobot_core.api import (
    DIAGNOSTICS,
    Context,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    Int8,
    JointReading,
    KeyValue,
    Message,
    Teleop,
    TeleopCommand,
    TeleopError,
    TwistStamped,
    Vector,
    Vector3,
    ns,
)
from ibrobot_core.app import Received, Service, Subscription
from ibrobot_kinematics import KinematicsError, Servo, ServoStatus, robot_model, world_clearance
from ibrobot_kinematics.options import TwistOptions

_STATUS_S = 0.1
"""The status is published when it changes, and at least that often [s]."""
_FOLLOW_RAD = 0.1
"""An arm at rest that is further from its setpoint was moved otherwise, so it starts from its measured position."""
_ASKED = 50
"""Number of ticks whose positions are remembered."""
_LATE = 10
"""A command follows at most so many ticks after its request."""
_OVERRULED_RAD = 1e-3
"""A command that is further from all requests is another's [rad]."""
_USED_LEAD = 0.7
"""Share of `max_lead` at which a tool with path constraints waits. Beyond it, control would hold back one joint."""
_PAUSE_NS = ns(0.5)
"""A stream of twists that was silent for so long counts as released [ns]."""
_SOON_NS = ns(0.25)
"""Time after the beginning of the mode in which a stream shows that it goes on [ns]."""


class TwistTeleop(Teleop):
    """The newest twist moves the tool until its timeout; then it slows down to a stop, and the robot holds.

    Twists other than zero count as a pressed deadman, a zero twist or a pause of 0.5 s as its release: a stream that
    goes on over a reset, a mode switch or a gap moves nothing before.

    Time is that of the measurements; the age of a twist counts from its arrival.
    """

    def __init__(self, options: TwistOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        gripper = ctx.robot.groups.get(options.gripper, ())
        self._arm = tuple(name for name in ctx.robot.joint_names if name not in gripper)
        self._indices = ctx.robot.indices(self._arm)
        self._servo: Servo | None = None
        self._chain: tuple[int, ...] = ()
        """Indices of the arm's joints that move the tool."""
        self._twists: Subscription | None = None
        self._serves = False
        """Whether it serves calls that send a twist."""
        self._quiet_since_ns = 0
        """When the last twist was read [ns]."""
        self._fresh = True
        """Whether the next twist starts from the measured position."""
        self._asked_for: deque[Vector] = deque(maxlen=_ASKED)
        """The arm's positions that were asked for last [rad], each of shape (N,)."""
        self._published: tuple[ServoStatus, int] | None = None
        """The last published status, and its time [ns]."""

    @override
    def connect(self) -> None:
        ctx, robot = self._ctx, self._ctx.robot
        if ctx.bus is None:
            raise TeleopError(f"{ctx.name}: twists come over the bus, which this process does not have")
        if robot.description.mjcf is None:
            raise TeleopError(f"{ctx.name}: twists move a tool, which needs robot.description.mjcf: set it")
        try:
            model = robot_model(robot, self._arm)
        except KinematicsError as error:
            raise TeleopError(f"{ctx.name}: {error}") from error
        self._chain = tuple(model.moving.tolist())
        limits = robot.max_velocity[self._indices], robot.max_acceleration[self._indices]
        self._servo = Servo(model, *limits, self._options, clearance=world_clearance(ctx.bus, self._arm))
        self._twists = ctx.bus.subscribe(self._options.topic, 10, TwistStamped)
        # Devices may share a topic; one of them serves it.
        self._serves = not ctx.bus.serves(self._options.topic)
        if self._serves:
            ctx.bus.serve(twist_service(self._options.topic), self._asked)
        self._fresh = True

    @override
    def activate(self, measured: JointReading) -> None:
        if self._servo is not None and self._twists is not None:
            self._servo.reset(measured.position[self._indices])
            came = bool(self._twists.drain())  # discards earlier twists
            # While the device was closed, a stream may have gone on: then the next twist comes soon.
            self._quiet_since_ns = measured.stamp_ns - (0 if came else _PAUSE_NS - _SOON_NS)
        self._fresh = True

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        servo, twists = self._servo, self._twists
        if servo is None or twists is None:
            raise TeleopError(f"{self._ctx.name}: twists are not connected: connect comes before read")
        here = measured.position[self._indices]
        if measured.stamp_ns - self._quiet_since_ns >= _PAUSE_NS:
            self.deadman.report(False, measured.stamp_ns)
        for received in twists.drain():
            self._take(servo, received, measured.stamp_ns, here)
        if not self.deadman.allows(measured.stamp_ns):
            servo.halt()
        self._heed_command(servo)
        keeps = self._options.path_constraints is not None
        waits = keeps and not self._follows(servo.stop_position(), here, _USED_LEAD)
        position = servo.step(measured.stamp_ns, waits=waits)
        moves = not servo.at_rest
        if not moves:
            self._asked_for.clear()
        elif not self._follows(position, here):
            # A joint is far behind: the tool waits for it, on the way that it came.
            position = self._back(position, here)
            servo.hold_at(position)
        if moves:
            self._asked_for.append(position)
        self._publish_status(servo, measured.stamp_ns)
        if not moves:
            return TeleopCommand(None)
        return TeleopCommand({self._arm[i]: float(position[i]) for i in self._chain})

    @override
    def disconnect(self) -> None:
        if self._twists is not None and self._ctx.bus is not None:
            self._twists.close()
            if self._serves:
                self._ctx.bus.unserve(self._options.topic)
        self._twists = self._servo = None

    @override
    def help(self) -> str:
        options = self._options
        frames = f"{options.frame} or {self._ctx.robot.description.tip}"
        return f"publish geometry_msgs/msg/TwistStamped on {options.topic}, its frame_id {frames}"

    def _commanded(self) -> Vector | None:
        """The arm's positions that control commands [rad], shape (N,); None without a run."""
        session = self._ctx.session
        if session is None or session.state is None:
            return None
        return np.asarray(session.state.command[session.config.robot.indices(self._arm)])

    def _heed_command(self, servo: Servo) -> None:
        """Go on from the command where it is not what was asked for, e.g. since the guard holds some joints back.

        Without path constraints, each joint may go on alone.
        """
        command = None if self._options.path_constraints is None else self._commanded()
        if command is None or not self._asked_for:
            return
        asked = list(self._asked_for)[-_LATE:]
        for before, after in pairwise([asked[0], *asked]):
            low, high = np.minimum(before, after) - _OVERRULED_RAD, np.maximum(before, after) + _OVERRULED_RAD
            if ((command >= low) & (command <= high)).all():
                return
        servo.overruled(command)
        self._asked_for.clear()
        self._asked_for.append(command)

    def _follows(self, position: Vector, here: Vector, share: float = 1.0) -> bool:
        """Whether no joint of the arm, at `here`, is further behind than a share of its `max_lead`."""
        return bool((np.abs(position - here) <= share * self._ctx.robot.max_lead[self._indices]).all())

    def _back(self, position: Vector, here: Vector) -> Vector:
        """The last position on the way to `position` that the arm, at `here`, can follow [rad], shape (N,)."""
        for asked in reversed(self._asked_for):
            if self._follows(asked, here):
                return asked.copy()
        # The arm was moved: nearer to it, all joints alike.
        lead = self._ctx.robot.max_lead[self._indices]
        return np.asarray(here + (position - here) * np.min(lead / np.maximum(np.abs(position - here), lead)))

    def _asked(self, request: TwistStamped) -> int:
        """Publish the twist of a service call; answers with the newest status."""
        assert self._ctx.bus is not None
        self._ctx.bus.publish(self._options.topic, request)
        return int(self._published[0]) if self._published is not None else int(ServoStatus.NO_WARNING)

    def _take(self, servo: Servo, received: Received, now_ns: int, here: Vector) -> None:
        """Follow a twist, or refuse it."""
        self._quiet_since_ns = now_ns
        message = received.message
        fault = self._fault(message, received.received_ns, now_ns)
        if fault is None:
            assert isinstance(message, TwistStamped)
            if servo.at_rest and (self._fresh or np.abs(servo.position - here).max() > _FOLLOW_RAD):
                command = None if self._options.path_constraints is None else self._commanded()
                servo.reset(here if command is None else command)
                self._asked_for.clear()
                self._asked_for.append(servo.position.copy())
            twist, in_tool = message.twist, message.header.frame_id == self._ctx.robot.description.tip
            fault = servo.command(_array(twist.linear), _array(twist.angular), now_ns, in_tool=in_tool)
            self._fresh &= fault is not None
        else:
            servo.refuse(fault)
        if fault is not None:
            self._report(servo, fault, now_ns)

    def _fault(self, message: Message, received_ns: int, now_ns: int) -> str | None:
        """Why a twist may not move the tool; reports a valid one to the deadman."""
        if not isinstance(message, TwistStamped):
            return f"not a {TwistStamped.ros_type}"
        frames = (self._options.frame, self._ctx.robot.description.tip)
        if message.header.frame_id not in ("", *frames):
            return f"its frame is neither {frames[0]} nor {frames[1]}"
        if self._ctx.clock.now_ns() - received_ns > ns(self._options.timeout):
            return "read too late"
        if refusal := self._ctx.clock.refusal(message.header.stamp_ns):
            return refusal
        moves = _array(message.twist.linear).any() or _array(message.twist.angular).any()
        self.deadman.report(bool(moves), now_ns)
        if not moves or self.deadman.allows(now_ns):
            return None
        return "the stream went on over a reset, a mode switch or a gap: send a zero twist, or pause for 0.5 s"

    def _report(self, servo: Servo, fault: str, now_ns: int) -> None:
        """Log the first refused twist for each reason, and publish the counts."""
        if servo.refused[fault] == 1:
            self._ctx.log.warning("%s: refused a twist: %s", self._ctx.name, fault)
        counts = tuple(KeyValue(reason, str(count)) for reason, count in servo.refused.items())
        status = DiagnosticStatus(
            DiagnosticStatus.WARN, f"{self._ctx.name}: refused twists", f"refused a twist: {fault}", values=counts
        )
        if self._ctx.bus is not None:
            self._ctx.bus.publish(DIAGNOSTICS, DiagnosticArray(Header(now_ns), (status,)))

    def _publish_status(self, servo: Servo, now_ns: int) -> None:
        if self._published is not None:
            status, then_ns = self._published
            if status == servo.status and 0 <= now_ns - then_ns < ns(_STATUS_S):
                return
        self._published = servo.status, now_ns
        if self._ctx.bus is not None:
            self._ctx.bus.publish(self._options.status_topic, Int8(int(servo.status)))


def twist_service(topic: str) -> Service[TwistStamped, int]:
    """The service of a topic of twists: moves the tool, and answers with the newest `ServoStatus`."""
    return Service(topic, TwistStamped, int, "Move the tool along a twist; answers with the newest status.")


def _array(vector: Vector3) -> Vector:
    return np.array([vector.x, vector.y, vector.z], dtype=float)
