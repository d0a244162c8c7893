"""Teleop `web`: jogs joints or the tool while a page holds its deadman."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from types import NoneType
from typing import Any, override

import attrs
import numpy as np
from ibrobot_kinematics import JogArm, JogMotion, VelocityJog

from ibrobot_core.api import (
    Context,
    JointReading,
    NoRequest,
    Service,
    Teleop,
    TeleopCommand,
    TeleopError,
    Vector,
    ns,
    seconds,
)
from ibrobot_web.options import WebTeleopOptions

_LONGEST_STEP_S = 0.1
"""Longest motion of one command [s], so that the robot does not jump after a pause of the host."""


def _fractions(size: int, values: Any, name: str) -> Vector:
    """A vector of numbers from -1 to 1, shape (size,)."""
    vector = np.asarray(values, dtype=float)
    if vector.shape != (size,) or not (np.abs(vector) <= 1.0).all():
        raise ValueError(f"{name} must be {size} numbers from -1 to 1")
    return vector


@attrs.frozen(eq=False)
class Jog:
    """The motion that a page requests while its deadman is held. Speeds are fractions of those in the options."""

    joints: Mapping[str, float] = attrs.field(factory=dict)
    """Joint -> speed, -1 to 1."""
    targets: Mapping[str, float] = attrs.field(factory=dict)
    """Joint -> position that it approaches [rad]."""
    linear: Vector = attrs.field(factory=lambda: np.zeros(3))
    """Velocity of the tool in the base frame, each component -1 to 1."""
    turn: Vector = attrs.field(factory=lambda: np.zeros(3))
    """Angular velocity about the tool's own axes, each component -1 to 1."""
    pose: str = ""
    """Named pose that all joints approach; empty for none."""
    press: int = 0
    """Number of the press of the deadman: a press that began before a reset or a new mode moves nothing."""

    @classmethod
    def read(cls, message: Mapping[str, Any]) -> Jog:
        """The request in a page's message.

        Raises:
            ValueError: for values of a wrong type or range.
        """
        parts: dict[str, dict[str, float]] = {}
        for name in ("joints", "targets"):
            given = message.get(name, {})
            if not isinstance(given, dict):
                raise ValueError(f"{name} must map joints to numbers")
            parts[name] = {str(joint): _number(value) for joint, value in given.items()}
        if any(abs(speed) > 1.0 for speed in parts["joints"].values()):
            raise ValueError("the speed of a joint must lie between -1 and 1")
        pose, press = message.get("pose", ""), message.get("press", 0)
        if not isinstance(pose, str) or not isinstance(press, int):
            raise ValueError("pose must be a name, press a whole number")
        try:
            linear = _fractions(3, message.get("linear", (0, 0, 0)), "linear")
            turn = _fractions(3, message.get("turn", (0, 0, 0)), "turn")
        except TypeError:
            raise ValueError("linear and turn must be lists of numbers") from None
        return cls(parts["joints"], parts["targets"], linear, turn, pose, press)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{value!r} is not a finite number")
    return float(value)


JOG = Service("/web_teleop/jog", Jog, NoneType, "Move the robot until the next call, or for the timeout.")
RELEASE = Service("/web_teleop/release", NoRequest, NoneType, "Release the deadman.")


class WebTeleop(Teleop):
    """Moves as the newest `Jog` says, for at most `timeout` after its arrival.

    The arrival counts by the run's clock. A page that is closed, hidden or out of reach sends nothing more, so its
    deadman is released after the timeout at the latest.
    """

    def __init__(self, options: WebTeleopOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self._arm = JogArm(ctx.robot, options.gripper)
        self._tool = ctx.robot.description.mjcf is not None
        self._jog = VelocityJog(self._arm, options.follow)
        self._lock = threading.Lock()
        self._request: Jog | None = None
        self._until_ns = 0
        """When the deadman counts as released [ns]."""
        self._refused = 0
        """The last press that a reset or a new mode ended."""
        self._seen = 0
        """The newest press."""
        self._moved_ns: int | None = None
        """When the last setpoint was computed [ns]; None while the deadman is released."""
        self._setpoint: Vector | None = None
        self._connected = False

    @override
    def connect(self) -> None:
        if self._ctx.bus is None:
            raise TeleopError(f"{self._ctx.name}: teleop web runs in the host, which has the page")
        if self._connected:
            return
        if self._tool:
            self._arm.load_model("robot.description.mjcf")
        self._ctx.bus.serve(JOG, self.take)
        self._ctx.bus.serve(RELEASE, lambda _: self.take(None))
        self._connected = True

    def take(self, request: Jog | None) -> None:
        """Accept a request; None releases the deadman. Thread-safe.

        Raises:
            TeleopError: for an unknown joint or pose, or for the tool of a robot without a model.
        """
        if request is not None:
            self._check(request)
        with self._lock:
            if request is None:
                self._request = None
                return
            self._seen = max(self._seen, request.press)
            if request.press > self._refused:
                self._request = request
                self._until_ns = self._ctx.clock.now_ns() + ns(self._options.timeout)

    @override
    def activate(self, measured: JointReading) -> None:
        with self._lock:
            self._request = None
            self._refused = self._seen
        self._moved_ns = self._setpoint = None
        self._jog.restart(measured.position)

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if not self._connected:
            raise TeleopError(f"{self._ctx.name}: teleop web is not connected: call connect before read")
        with self._lock:
            if self._request is not None and self._ctx.clock.now_ns() >= self._until_ns:
                self._request = None
            request = self._request
        now_ns = measured.stamp_ns
        if request is None:
            self._moved_ns = self._setpoint = None
            return TeleopCommand(None)
        if self._moved_ns is None or self._setpoint is None:
            self._jog.restart(measured.position)
            self._setpoint = measured.position.copy()
        dt = min(max(seconds(now_ns - self._moved_ns), 0.0), _LONGEST_STEP_S) if self._moved_ns is not None else 0.0
        self._moved_ns = now_ns
        self._setpoint = self._jog.move(measured.position, self._motion(request, self._setpoint, dt), dt)
        return TeleopCommand(dict(zip(self._ctx.robot.joint_names, self._setpoint.tolist(), strict=True)))

    @override
    def disconnect(self) -> None:
        if self._connected and self._ctx.bus is not None:
            self._ctx.bus.unserve(JOG)
            self._ctx.bus.unserve(RELEASE)
        self._connected = False
        self._request = self._moved_ns = self._setpoint = None

    @override
    def help(self) -> str:
        return "jog from the page of the viewer web, while a button is held"

    def _check(self, request: Jog) -> None:
        robot = self._ctx.robot
        for joint in (*request.joints, *request.targets):
            if joint not in robot.joint_names:
                raise TeleopError(f"no joint {joint!r}; the joints are: {', '.join(robot.joint_names)}")
        if request.pose and request.pose not in robot.description.poses:
            raise TeleopError(f"no pose {request.pose!r}; the poses are: {', '.join(robot.description.poses)}")
        if not self._tool and (request.linear.any() or request.turn.any()):
            raise TeleopError("moving the tool needs robot.description.mjcf: set it")

    def _motion(self, request: Jog, setpoint: Vector, dt: float) -> JogMotion:
        options, robot = self._options, self._ctx.robot
        if request.pose:
            still = np.zeros(len(robot.joints))
            return JogMotion(still, pose=robot.pose(request.pose).copy(), pose_speed=options.joint_speed)
        velocity = np.zeros(len(robot.joints))
        for joint, speed in request.joints.items():
            velocity[robot.indices((joint,))] = speed * options.joint_speed
        for joint, target in request.targets.items():
            index = robot.indices((joint,))
            wanted = (target - setpoint[index]) / dt if dt > 0 else 0.0
            velocity[index] = np.clip(wanted, -options.joint_speed, options.joint_speed)
        return JogMotion(velocity, request.linear * options.tool_speed, request.turn * options.turn_speed)
