"""Teleop `imu`: an orientation sensor in a hand moves the tool by its tilt while a deadman is held."""

from __future__ import annotations

import math
import queue
from typing import override

import numpy as np
import serial
from ibrobot_kinematics import JogArm, JogMotion, VelocityJog
from ibrobot_kinematics.rotations import from_rpy, log
from ibrobot_terminal import HeldKeys

from ibrobot_core.api import Context, JointReading, Teleop, TeleopCommand, TeleopError, Vector, ns
from ibrobot_imu.messages import READERS
from ibrobot_imu.options import TILTS, TOOL_AXES, ImuOptions

_MOST_BYTES = 4096
"""Most bytes read at once: a third of a second at 115200 baud."""
_SILENT_NS = ns(1.0)
"""Time without a valid message until a warning [ns]."""


class ImuTeleop(Teleop):
    """Moves the tool at a velocity given by the tilt since the deadman was pressed. Time is that of the measurements.

    Each press makes the present orientation the zero, so that neither drift nor the mounting matters. Without valid
    messages the robot holds, and the deadman must be pressed again. A key counts as pressed from its first repeat.
    """

    def __init__(self, options: ImuOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self._arm = JogArm(ctx.robot, options.gripper)
        self._jog = VelocityJog(self._arm, options.follow)
        self._reader = READERS[options.model]()
        self._port: serial.Serial | None = None
        self._keys: queue.SimpleQueue[str] | None = None
        self._orientation: Vector | None = None
        """Axes of the sensor as columns, shape (3, 3); None before the first message."""
        self._received_ns = 0
        """When it came [ns]."""
        self._warned = False
        self._held = HeldKeys(options.release)
        self._key_deadman = options.deadman == "key"
        self._zero: Vector | None = None
        """The orientation at the press; None while released."""

    @override
    def connect(self) -> None:
        options, name = self._options, self._ctx.name
        if options.deadman == "key" and self._ctx.keys is None:
            raise TeleopError(
                f"{name}: deadman: key needs a terminal: start ibrobot in one, without --headless and without "
                "redirecting its input, or wire a button to the port and set deadman: cts"
            )
        self._arm.load_model("another type of device", self._ctx.bus)
        try:
            port = serial.Serial(options.port, options.rate, timeout=0, exclusive=True)
        except (serial.SerialException, ValueError) as error:
            raise TeleopError(
                f"{name}: {options.port}: cannot be opened: {error}; `ibrobot doctor` checks it"
            ) from None
        self._port = port
        try:
            self._pressed(port)
        except OSError as error:
            self.disconnect()
            raise TeleopError(f"{name}: {options.port} has no line {options.deadman}: {error}") from None
        self._keys = self._ctx.keys() if self._ctx.keys is not None else None
        self._orientation = None
        self._received_ns = self._ctx.clock.now_ns()
        self._warned = False

    @override
    def activate(self, measured: JointReading) -> None:
        self._held.take(self._keys, measured.stamp_ns)
        self._held.forget()
        self._zero = None
        self._received_ns = measured.stamp_ns
        self._orientation = None

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        port = self._port
        if port is None:
            raise TeleopError(f"{self._ctx.name}: the sensor is not connected: call connect before read")
        now_ns, options = measured.stamp_ns, self._options
        self._held.take(self._keys, now_ns)
        try:
            self._receive(port, now_ns)
            held = self._held.held(options.deadman_key) if self._key_deadman else self._pressed(port)
        except OSError as error:
            raise TeleopError(f"{self._ctx.name}: lost {options.port}: {error}") from None
        orientation = self._orientation
        if now_ns - self._received_ns > ns(options.timeout):
            self.deadman.disarm(now_ns)
        elif orientation is not None:
            # A line of the port counts only while messages arrive on the same port.
            self.deadman.report(held, self._received_ns)
        if orientation is None or not self.deadman.allows(now_ns):
            self._zero = None
            return TeleopCommand(None)
        if self._zero is None:
            self._zero = orientation
            self._jog.rest()
        dt = self._jog.step(measured)
        setpoint = self._jog.move(measured.position, self._motion(self._zero.T @ orientation), dt)
        return TeleopCommand(dict(zip(self._ctx.robot.joint_names, setpoint.tolist(), strict=True)))

    @override
    def disconnect(self) -> None:
        port, self._port, self._keys, self._zero = self._port, None, None, None
        self._reader.forget()
        if port is not None:
            port.close()

    @override
    def help(self) -> str:
        options = self._options
        key = options.deadman_key + ("" if self._held.exact else " (known by its repeats)")
        button = {"key": key, "cts": "the button at CTS", "dsr": "the button at DSR"}[options.deadman]
        state = "moves" if self._zero is not None else "no message yet" if self._orientation is None else "waits"
        moves = ", ".join(f"{tilt} {axis}" for axis, tilt in options.axes.items())
        return f"{options.model} {state}: hold {button} and tilt ({moves})"

    def _pressed(self, port: serial.Serial) -> bool:
        """Whether the button at the port's line is pressed.

        Raises:
            OSError: if the port has no such line.
        """
        match self._options.deadman:
            case "cts":
                return bool(port.cts)
            case "dsr":
                return bool(port.dsr)
        return False

    def _receive(self, port: serial.Serial, now_ns: int) -> None:
        """Take the newest orientation, if one came.

        Raises:
            OSError: if the port is gone.
        """
        angles = self._reader.feed(port.read(min(port.in_waiting, _MOST_BYTES)))
        if angles:
            self._received_ns, self._warned = now_ns, False
            turns = angles[-1]
            self._orientation = from_rpy(turns.roll, turns.pitch, turns.yaw)
        elif now_ns - self._received_ns > _SILENT_NS and not self._warned:
            self._warned = True
            self._ctx.log.warning(
                "%s: no valid message on %s for 1 s, %d bytes refused; the robot holds: check wiring, model and "
                "baud_rate",
                self._ctx.name,
                self._options.port,
                self._reader.refused,
            )

    def _motion(self, turned: Vector) -> JogMotion:
        """The motion of the tool for a rotation since the press, shape (3, 3)."""
        options = self._options
        tilts = dict(zip(TILTS, log(turned), strict=True))
        moves = dict.fromkeys(TOOL_AXES, 0.0)
        for axis, tilt in options.axes.items():
            angle = float(tilts[tilt.removeprefix("-")]) * (-1 if tilt.startswith("-") else 1)
            share = (abs(angle) - options.dead_zone) / (options.full_tilt - options.dead_zone)
            moves[axis] = math.copysign(min(1.0, max(0.0, share)), angle)
        x, y, z, roll, pitch, yaw = moves.values()
        linear, turn = np.array([x, y, z]), np.array([yaw, pitch, roll])  # the tool points along its z
        still = np.zeros(len(self._ctx.robot.joints))
        return JogMotion(still, linear * options.speed, turn * options.turn_speed)
