"""Teleop `lerobot`: a teleoperator of LeRobot's that has joint positions, with a deadman of ours."""

from __future__ import annotations

import queue
from collections.abc import Mapping
from typing import Any, override

import numpy as np
from ibrobot_terminal import HeldKeys

from ibrobot_core.api import Approach, Context, JointReading, Teleop, TeleopCommand, TeleopError, Vector
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem, age_ns
from ibrobot_lerobot_devices.options import TeleopOptions
from ibrobot_lerobot_devices.units import POSITION, UnitProblem, bases, columns, map_joints

_WAIT_S = 0.002
"""How long a tick waits for a new reading [s]; a leader on a servo bus answers within that."""
_TAKEN_UP = 0.06
"""A joint that turned by more was moved by hand [rad]."""


class LeRobotTeleop(Teleop):
    """Maps a device's joints to the robot's; approaches them slowly at first, then follows directly.

    LeRobot's calls block in a process of their own. Arrays have one element for each mapped joint, shape (S,).
    """

    def __init__(self, options: TeleopOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self._link = DeviceLink("teleoperator", options.teleop, options.config, torch=options.torch)
        self._keys: queue.SimpleQueue[str] | None = None
        self._held = HeldKeys(options.release)
        self._lost = 0
        self._pose: Vector | None = None
        """The device's pose [rad]; None until it is read."""
        self._approach = Approach(options.follow_tolerance)
        self._toggled = self._taken_up = False
        self._resting: Vector | None = None
        """The device's pose at the start of the mode [rad]; None until it is read."""

    @override
    def connect(self) -> None:
        options = self._options
        if options.deadman != "none" and self._ctx.keys is None:
            raise self._error(
                f"deadman: {options.deadman} needs a terminal: start ibrobot in one, without --headless and without "
                "redirecting its input, or set deadman: none, so that the robot follows once the device is moved"
            )
        try:
            answer = self._link.start(options.start_timeout)
            self._map(answer)
        except (DeviceProblem, UnitProblem) as problem:
            self.disconnect()
            raise self._error(problem) from None
        self._pose, self._lost = None, 0
        self._keys = self._ctx.keys() if self._ctx.keys is not None else None

    @override
    def activate(self, measured: JointReading) -> None:
        self._held.take(self._keys, measured.stamp_ns)
        self._held.forget()
        self._release()

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        now_ns = measured.stamp_ns
        try:
            answer = self._link.read(_WAIT_S)
        except DeviceProblem as problem:
            raise self._error(problem) from None
        self._held.take(self._keys, now_ns)
        engaged = None if answer is None else self._receive(answer)
        if engaged is not None:
            self.deadman.report(engaged, self._ctx.clock.now_ns() - age_ns(answer or {}))
        elif self._link.blocked_s > self._options.blocked:
            self._pose = None
            raise self._error(self._link.blockage("get_action"))
        if not self.deadman.allows(now_ns) or self._pose is None:
            self._approach.setpoint = None
            if not self.deadman.armed:
                self._release()
            return TeleopCommand(None)
        setpoint = self._approach.next(measured.position[self._columns], self._pose, self._ramp, now_ns)
        positions = dict(zip(self._joints, setpoint.tolist(), strict=True))
        return TeleopCommand(positions, approaching=not self._approach.following)

    @override
    def disconnect(self) -> None:
        self._keys = None
        self._link.end()

    @override
    def help(self) -> str:
        key, deadman = self._options.deadman_key, self._options.deadman
        start = {
            "none": "move the device to start",
            "toggle": f"press {key} to follow the device",
            "hold": f"hold {key} to follow the device{'' if self._held.exact else ' (known by its repeats)'}",
        }
        pause = {"none": "", "toggle": f": {key} pauses", "hold": f": release {key} to pause"}
        paused = self._approach.setpoint is None
        return f"PAUSED: {start[deadman]}" if paused else f"following the device{pause[deadman]}"

    def _map(self, answer: Mapping[str, Any]) -> None:
        """Map the device's joints to the robot's.

        Raises:
            UnitProblem: if the device has no joint positions, or none of a joint of the robot.
        """
        features, robot, options = answer["action_features"], self._ctx.robot, self._options
        positions = bases(features, POSITION)
        if not positions:
            raise UnitProblem(
                f"LeRobot's {options.teleop} commands {', '.join(features) or 'nothing'}, and no joint positions; "
                "use a device of ibrobot for it, e.g. type: keyboard"
            )
        limits = dict(zip(robot.joint_names, zip(robot.lower, robot.upper, strict=True), strict=True))
        known = {options.names.get(base, base) for base in positions}
        self._joints = tuple(joint for joint in robot.joint_names if joint in known) or robot.joint_names
        mapped = map_joints(features, answer["motors"], options.choices(), self._joints, limits)
        self._names = [positions[each.feature] for each in mapped]
        self._factor, self._offset = columns(mapped)
        self._columns = robot.indices(self._joints)
        self._lower, self._upper = robot.lower[self._columns], robot.upper[self._columns]
        self._ramp = np.minimum(options.ramp_velocity, robot.max_velocity[self._columns])

    def _receive(self, answer: Mapping[str, Any]) -> bool | None:
        """Take a reading in; return whether the deadman is pressed, or None without a reading."""
        values = [] if "error" in answer else [answer["values"].get(name, np.nan) for name in self._names]
        if not values or not np.isfinite(values).all():
            self._lost += 1
            if self._lost > self._options.lost_readings:
                raise self._error(answer.get("error", "LeRobot gives positions that are not finite"))
            return None
        self._lost = 0
        self._pose = np.clip(self._factor * np.array(values) + self._offset, self._lower, self._upper)
        return self._engaged(self._pose)

    def _release(self) -> None:
        """Return to the paused state, so that following begins with an approach."""
        self._approach.setpoint = self._resting = None
        self._toggled = self._taken_up = False

    def _engaged(self, pose: Vector) -> bool:
        """Whether the deadman is pressed."""
        key = self._options.deadman_key
        match self._options.deadman:
            case "toggle":
                self._toggled = self._held.toggled(key, self._toggled)
                return self._toggled
            case "hold":
                return self._held.held(key)
        if self._resting is None:
            self._resting = pose
        self._taken_up = self._taken_up or bool(np.abs(pose - self._resting).max() > _TAKEN_UP)
        return self._taken_up

    def _error(self, text: object) -> TeleopError:
        return TeleopError(f"{self._ctx.name}: {text}")
