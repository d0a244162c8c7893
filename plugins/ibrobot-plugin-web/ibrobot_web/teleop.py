"""Teleop `web`: jogs joints or the tool while a page holds its deadman."""

from __future__ import annotations

import threading
from functools import partial
from types import NoneType
from typing import override
from weakref import WeakKeyDictionary

import attrs
import numpy as np
from ibrobot_kinematics import JogArm, JogMotion, VelocityJog

from ibrobot_core.api import (
    Context,
    JointReading,
    Teleop,
    TeleopCommand,
    TeleopError,
    documented,
    ns,
    option,
)
from ibrobot_core.app import Bus, Service
from ibrobot_web.messages import Motion
from ibrobot_web.options import WebTeleopOptions

_SAME_PRESS_NS = 500_000
"""Two presses begin further apart [ns]; the begin of one may differ by less from message to message."""


@documented
@attrs.frozen
class Jog(Motion):
    """A request to `/web_teleop/jog`: the motion while a page's deadman is held, as fractions of the top speeds."""

    made_ns: int = option(unit="ns", help="when the page made it, by the run's clock")
    began_ns: int = option(unit="ns", help="when the present press of the deadman began")


@documented
@attrs.frozen
class Released:
    """A request to `/web_teleop/release`."""

    at_ns: int | None = option(None, unit="ns", help="when; presses that began earlier no longer count. By default now")


JOG = Service("/web_teleop/jog", Jog, NoneType, "Move the robot until the next call, or for the timeout.")
RELEASE = Service("/web_teleop/release", Released, NoneType, "Release the deadman.", urgent=True)
_devices: WeakKeyDictionary[Bus, dict[str, WebTeleop]] = WeakKeyDictionary()
"""The open devices of each run, by name: a mode may have one for each arm, which share the services."""
_opening = threading.Lock()


def _take(devices: dict[str, WebTeleop], request: Jog | Released) -> None:
    """Pass a request on: a jog to its device, a release to all."""
    with _opening:
        opened = dict(devices)
    if isinstance(request, Released):
        for device in opened.values():
            device.take(request)
        return
    name = request.device or (next(iter(opened), "") if len(opened) == 1 else "")
    if name not in opened:
        known = ", ".join(opened)
        raise TeleopError(f"device {request.device!r} does not jog in this mode; those that do are: {known}")
    opened[name].take(request)


class WebTeleop(Teleop):
    """Moves as the newest `Jog` says, for at most `timeout` after the page made it.

    A page that is closed, hidden, stopped or out of reach sends nothing in time, which ends its press: the next one
    must begin later.
    """

    def __init__(self, options: WebTeleopOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self._arm = JogArm(ctx.robot, options.gripper)
        self._tool = ctx.robot.description.mjcf is not None
        self._jog = VelocityJog(self._arm, options.follow)
        self._lock = threading.Lock()
        self._request: Jog | None = None
        self._released_ns = -1
        """The end of the last press [ns]: presses that began earlier do not count."""
        self._connected = False

    @override
    def connect(self) -> None:
        if self._ctx.bus is None:
            raise TeleopError(f"{self._ctx.name}: teleop web runs in the host, which has the page")
        if self._connected:
            return
        if self._tool:
            self._arm.load_model("robot.description.mjcf", self._ctx.bus)
        with _opening:
            devices = _devices.setdefault(self._ctx.bus, {})
            if not devices:
                self._ctx.bus.serve(JOG, partial(_take, devices))
                self._ctx.bus.serve(RELEASE, partial(_take, devices))
            devices[self._ctx.name] = self
        self._connected = True

    def take(self, request: Jog | Released) -> None:
        """Accept a request. Thread-safe.

        Raises:
            TeleopError: for an unknown joint or pose, or for the tool of a robot without a model.
        """
        now_ns = self._ctx.clock.now_ns()
        if isinstance(request, Released):
            with self._lock:
                self._end_press(now_ns if request.at_ns is None else min(request.at_ns, now_ns))
                self.deadman.report(False, now_ns)
            return
        self._check(request)
        with self._lock:
            if request.began_ns <= self._released_ns:
                return
            if self._request is None or request.began_ns > self._request.began_ns + _SAME_PRESS_NS:
                self.deadman.report(False, request.began_ns)
            self.deadman.report(True, request.made_ns)
            self._request = request

    def _end_press(self, at_ns: int) -> None:
        self._request = None
        self._released_ns = max(at_ns, self._released_ns)

    @override
    def activate(self, measured: JointReading) -> None:
        with self._lock:
            self._end_press(self._ctx.clock.now_ns())
        self.deadman.disarm(self._ctx.clock.now_ns())
        self._jog.rest()

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if not self._connected:
            raise TeleopError(f"{self._ctx.name}: teleop web is not connected: call connect before read")
        clock_ns = self._ctx.clock.now_ns()
        with self._lock:
            allowed = self.deadman.allows(clock_ns)
            request = self._request
            if request is not None and not (allowed and clock_ns - request.made_ns < ns(self._options.timeout)):
                self._end_press(clock_ns)
                self.deadman.disarm(clock_ns)
            request = self._request
        if request is None:
            self._jog.rest()
            return TeleopCommand(None)
        dt = self._jog.step(measured)
        setpoint = self._jog.move(measured.position, self._motion(request, dt), dt)
        return TeleopCommand(dict(zip(self._ctx.robot.joint_names, setpoint.tolist(), strict=True)))

    @override
    def disconnect(self) -> None:
        if self._connected and self._ctx.bus is not None:
            with _opening:
                devices = _devices[self._ctx.bus]
                del devices[self._ctx.name]
                if not devices:
                    for service in (JOG, RELEASE):
                        self._ctx.bus.unserve(service)
        self._connected = False
        self._request = None
        self._jog.rest()

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
        if not self._tool and (any(request.linear) or any(request.turn)):
            raise TeleopError("moving the tool needs robot.description.mjcf: set it")

    def _motion(self, request: Jog, dt: float) -> JogMotion:
        options, robot = self._options, self._ctx.robot
        if request.pose:
            still = np.zeros(len(robot.joints))
            return JogMotion(still, pose=robot.pose(request.pose).copy(), pose_speed=options.joint_speed)
        velocity = np.zeros(len(robot.joints))
        for joint, speed in request.joints.items():
            velocity[robot.indices((joint,))] = speed * options.joint_speed
        for joint, target in request.targets.items():
            index = robot.indices((joint,))
            wanted = (target - self._jog.setpoint[index]) / dt if dt > 0 else 0.0
            velocity[index] = np.clip(wanted, -options.joint_speed, options.joint_speed)
        linear, turn = np.asarray(request.linear), np.asarray(request.turn)
        return JogMotion(velocity, linear * options.tool_speed, turn * options.turn_speed)
