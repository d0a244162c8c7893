"""Teleop `lerobot`: a teleoperator of LeRobot's that has joint positions, with a deadman of ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, override

import numpy as np
from ibrobot_terminal.hand_moved import HandMoved

from ibrobot_core.api import Context, JointReading, Teleop, TeleopCommand, TeleopError, Vector
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
        self._hand = HandMoved(options, ctx, "device", _TAKEN_UP)
        self._lost = 0
        self._pose: Vector | None = None
        """The device's pose [rad]; None until it is read."""

    @override
    def connect(self) -> None:
        self._hand.check()
        try:
            answer = self._link.start(self._options.start_timeout)
            self._map(answer)
        except (DeviceProblem, UnitProblem) as problem:
            self.disconnect()
            raise self._error(problem) from None
        self._pose, self._lost = None, 0
        self._hand.connect()

    @override
    def activate(self, measured: JointReading) -> None:
        self._hand.activate(measured.stamp_ns)

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        now_ns = measured.stamp_ns
        try:
            answer = self._link.read(_WAIT_S)
        except DeviceProblem as problem:
            raise self._error(problem) from None
        self._hand.take(now_ns)
        engaged = None if answer is None else self._receive(answer)
        if engaged is not None:
            self.deadman.report(engaged, self._ctx.clock.now_ns() - age_ns(answer or {}))
        elif self._link.blocked_s > self._options.blocked:
            self._pose = None
            raise self._error(self._link.blockage("get_action"))
        where = measured.position[self._columns]
        return self._hand.command(self.deadman, self._joints, where, self._pose, self._ramp, now_ns)

    @override
    def disconnect(self) -> None:
        self._hand.disconnect()
        self._link.end()

    @override
    def help(self) -> str:
        return self._hand.help()

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
        return self._hand.engaged(self._pose)

    def _error(self, text: object) -> TeleopError:
        return TeleopError(f"{self._ctx.name}: {text}")
