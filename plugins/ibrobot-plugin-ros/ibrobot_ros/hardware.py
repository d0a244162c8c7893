"""Hardware that ros2_control drives elsewhere: joint states come from a topic, commands go to a controller's."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, override

import attrs
import numpy as np
from ibrobot_ros2 import decode, encode

from ibrobot_core.api import (
    NS_PER_S,
    Context,
    Float64MultiArray,
    Hardware,
    HardwareError,
    Header,
    IbrobotError,
    JointReading,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    Message,
    Vector,
    nan_vector,
    ns,
)
from ibrobot_core.app import error_text
from ibrobot_ros.options import Ros2ControlOptions
from ibrobot_ros.process import NodeProcess

_FIRST_S = 10.0
"""How long a connection waits for the controller and its first state [s]."""
_GLANCE_S = 0.05
_RATE_HZ = 2000.0
_OLDEST_NS, _EARLIEST_NS = ns(0.5), ns(0.02)
"""How old a state may be, and how far ahead of the clock its stamp may be [ns]."""
_OTHER_NS = ns(10.0)
"""Age from which a stamp is that of another clock [ns]."""
_BACKLOG = 1 << 20
"""Bytes of commands that a node may leave unread before it counts as stopped."""


class Ros2Control(Hardware):
    """The joints of a robot whose controllers run in ROS.

    A node in a process of its own has the topics, so that its threads do not delay the control loop. A tick without a
    new state is stale, as after a lost reply: silence for `control.state_timeout` is a fault. The torque is the
    controller's own: it cannot be switched off here.
    """

    def __init__(self, options: Ros2ControlOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        self._options = options
        self._ctx = ctx
        self._node: NodeProcess | None = None
        self._last: JointReading | None = None
        self._listeners = 0
        self._order: tuple[str, ...] = ()
        self._columns: list[int] = []
        self._fault = ""
        self._counts = {"states": 0, "silent_ticks": 0}
        prefix = "/" + options.controller.strip("/")
        self._topic = f"{prefix}/commands" if options.command == "positions" else f"{prefix}/joint_trajectory"

    @override
    def connect(self) -> None:
        self.disconnect()
        options = self._options
        try:
            node = self._node = NodeProcess(options, f"ibrobot_{self._ctx.name}")
        except IbrobotError as error:
            raise HardwareError(error_text(error, "; ")) from error
        types = {"positions": Float64MultiArray.ros_type, "trajectory": JointTrajectory.ros_type}
        node.channel.send({"op": "publisher", "topic": self._topic, "type": types[options.command], "qos": "default"})
        states = {"topic": options.states, "type": JointState.ros_type, "qos": "default", "rate_hz": _RATE_HZ}
        node.channel.send({"op": "subscriber", **states})
        try:
            self._await_controller()
        except BaseException:
            self.disconnect()
            raise

    def _await_controller(self) -> None:
        deadline_s = time.monotonic() + _FIRST_S
        while not (self._last and self._listeners):
            self._take(_GLANCE_S)
            if self._fault and self._last is None:
                raise HardwareError(self._fault)
            if time.monotonic() > deadline_s:
                if self._last is None:
                    raise HardwareError(f"no node publishes {self._options.states} with {', '.join(self.joints)}")
                raise HardwareError(
                    f"nobody subscribes {self._topic}: is the controller active, and does it take "
                    f"{self._options.command}?"
                )

    @override
    def read(self) -> JointReading:
        before = self._last
        self._take(0.0)
        reading = self._last
        if self._fault:
            fault, self._fault = self._fault, ""
            raise HardwareError(fault)
        if reading is None:
            raise HardwareError(f"no state has come on {self._options.states}")
        if reading is before:
            self._counts["silent_ticks"] += 1
            return attrs.evolve(reading, stamp_ns=self._ctx.clock.now_ns(), stale=True)
        return reading

    @override
    def write(self, position: Vector) -> None:
        if position.shape != (len(self.joints),):
            raise HardwareError(f"position must have shape ({len(self.joints)},), got {position.shape}")
        channel = self._open().channel
        if channel.backlog > _BACKLOG:
            raise HardwareError("the ROS node of the hardware does not take commands: it is stopped, or overloaded")
        channel.send({"op": "message", "topic": self._topic}, encode(self._command(position)).tobytes())

    def _command(self, position: Vector) -> Message:
        if self._options.command == "positions":
            return Float64MultiArray(position.copy())
        point = JointTrajectoryPoint(2 * self._ctx.period_ns, position.copy())
        return JointTrajectory(Header(), self.joints, (point,))

    @override
    def disconnect(self) -> None:
        node, self._node = self._node, None
        self._last, self._listeners, self._fault = None, 0, ""
        if node is not None:
            node.channel.send({"op": "end"})
            node.channel.flush(1.0)
            node.close()

    @override
    def reset_faults(self) -> None:
        self._fault = ""
        if self._node is None or self._node.channel.closed:
            self.connect()

    @override
    def counters(self) -> Mapping[str, int]:
        return dict(self._counts)

    def _open(self) -> NodeProcess:
        """The node.

        Raises:
            HardwareError: if it is not connected, or dead.
        """
        if self._node is None:
            raise HardwareError("the hardware is not connected")
        if self._node.channel.closed:
            raise HardwareError(f"the ROS node of the hardware died: {self._node.cause()}")
        return self._node

    def _take(self, timeout_s: float) -> None:
        """Take what has come; of several states, the newest."""
        node = self._open()
        newest = memoryview(b"")
        for head in node.channel.receive(timeout_s):
            if head["op"] == "message":
                newest = head.payload
            elif head["op"] == "matched":
                self._listeners = head["subscribers"]
            elif head["op"] == "trouble":
                self._ctx.log.warning("ros2_control: %s: %s", head["topic"], head["what"])
        if newest:
            self._accept(newest)
        if not self._listeners and self._last is not None and not timeout_s:
            self._fault = self._fault or f"nobody subscribes {self._topic} any more: the controller is gone"

    def _accept(self, payload: memoryview) -> None:
        try:
            message = decode(JointState.ros_type, payload)
        except IbrobotError as error:
            self._fault = str(error)
            return
        assert isinstance(message, JointState)
        if message.name != self._order:
            missing = [joint for joint in self.joints if joint not in message.name]
            if missing:
                return  # other publishers of the topic have other joints
            self._order = message.name
            self._columns = [message.name.index(joint) for joint in self.joints]
        position = self._part(message.position)
        if not np.isfinite(position).all():
            joint = self.joints[int(np.argmin(np.isfinite(position)))]
            self._fault = f"{self._options.states}: the position of {joint} is not a number"
            return
        stamp_ns = self._stamp_ns(message)
        if stamp_ns is not None:
            self._counts["states"] += 1
            velocity = self._velocity(self._part(message.velocity), position, stamp_ns)
            self._last = JointReading(stamp_ns, position, velocity, self._part(message.effort))

    def _part(self, values: Any) -> Vector:
        """The values of this hardware's joints; NaN if the message has none."""
        if len(values) != len(self._order):
            return nan_vector(len(self.joints))
        return np.asarray(values, dtype=np.float64)[self._columns]

    def _velocity(self, measured: Vector, position: Vector, stamp_ns: int) -> Vector:
        """The velocity [rad/s]; computed from the last two states for controllers that do not measure it."""
        if np.isfinite(measured).all():
            return measured
        before = self._last
        if before is None or stamp_ns <= before.stamp_ns:
            return np.zeros(len(self.joints))
        return (position - before.position) * (NS_PER_S / (stamp_ns - before.stamp_ns))

    def _stamp_ns(self, message: JointState) -> int | None:
        """The time of a state; None if it is older than the last."""
        now_ns = self._ctx.clock.now_ns()
        if self._options.stamp == "receive":
            return now_ns
        age_ns = now_ns - message.header.stamp_ns
        if _OLDEST_NS < age_ns < _OTHER_NS:
            return None  # late: if no other comes, this is silence
        if not -_EARLIEST_NS <= age_ns <= _OLDEST_NS:
            self._fault = (
                f"{self._options.states}: its stamps are {age_ns / NS_PER_S:.3g} s off this machine's clock; if its "
                "clock is another one, set stamp: receive"
            )
            return None
        if self._last is not None and message.header.stamp_ns <= self._last.stamp_ns:
            return None
        return min(message.header.stamp_ns, now_ns)
