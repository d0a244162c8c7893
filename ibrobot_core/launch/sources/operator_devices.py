"""The devices with which an operator moves the robot in a mode."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.control.plausible import Plausibility
from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import JointReading, Teleop, TeleopCommand
from ibrobot_core.interfaces.run import StreamingRun
from ibrobot_core.pulses import Pulse
from ibrobot_core.robot import Robot, Vector
from ibrobot_core.units import ns

_BLOCKED_S = 6.0
"""Time without a sign of life of the thread that reads devices after which the run ends [s]; the answer of control may
take 5 s."""


@attrs.define(eq=False)
class _Connected:
    """A device, the indices of the joints that it sees and moves, and the last positions that were believed."""

    name: str
    device: Teleop
    columns: NDArray[np.intp]
    robot: Robot
    plausibility: Plausibility
    lost: bool = False
    followed: Vector | None = None
    """[rad], shape (J,); None while it commands nothing."""
    followed_ns: int = 0

    def believed(self, command: TeleopCommand, measured: JointReading, patience_ns: int) -> TeleopCommand:
        """The command, or the one before it while it jumps to where no hand can have moved the device.

        Raises:
            TeleopError: if that lasts for `patience_ns`, or it commands joints that are not its own.
        """
        now_ns, robot, positions = measured.stamp_ns, self.robot, command.positions
        if positions is None:
            self.followed = None
            return command
        if strange := set(positions) - set(robot.joint_names):
            raise TeleopError(f"{self.name}: commands joints that are not its own: {', '.join(sorted(strange))}")
        before = measured.position if self.followed is None else self.followed
        wanted = np.array([positions.get(joint, at) for joint, at in zip(robot.joint_names, before, strict=True)])
        # A trigger snaps; what it grips with follows within its limits.
        steady = np.where(robot.grips & np.isfinite(wanted), before, wanted)
        if self.followed is None or not (jump := self.plausibility.jump(before, steady, now_ns - self.followed_ns)):
            self.followed, self.followed_ns = wanted, now_ns
            return command
        if now_ns - self.followed_ns > patience_ns:
            raise TeleopError(f"{self.name}: {jump}")
        kept = dict(zip(robot.joint_names, before.tolist(), strict=True))
        return attrs.evolve(command, positions={joint: kept[joint] for joint in positions})


class OperatorDevices:
    """Teleoperation devices, each of which sees its group of joints as the whole robot.

    Modes that have a device in common share it, so that the robot can switch between them.

    Args:
        session: the run.
        devices: joint group -> name of the device that moves it; empty group: a device that may move all joints.

    Attributes:
        pulse: the signs of life of the thread that reads them, from `connect` to `disconnect`. It must beat at every
            unit of work, and pause for what may take long.
    """

    def __init__(self, session: StreamingRun, devices: Mapping[str, str]) -> None:
        self._session = session
        self._devices = devices
        self._connected: list[_Connected] = []
        control = session.config.control
        self._period_ns, self._patience_ns = ns(1.0 / control.rate_hz), ns(control.state_timeout)
        self.pulse = Pulse(f"teleop {self}", _BLOCKED_S)

    def __str__(self) -> str:
        types = self._session.config.teleoperation
        return ", ".join(
            f"{name} ({types[name].type})" + (f" moves {group}" if group else "")
            for group, name in self._devices.items()
        )

    def connect(self) -> None:
        """Open the devices.

        Raises:
            TeleopError: if one cannot be opened.
        """
        robot = self._session.config.robot
        for group, name in self._devices.items():
            part = robot.part(group) if group else robot
            device = self._session.devices.take((group, name), partial(self._opened, name, part))
            self._connected.append(
                _Connected(name, device, robot.indices(part.joint_names), part, Plausibility(part, self._period_ns))
            )
        self.pulse.beat()
        self._session.pulses.add(self.pulse)

    def disconnect(self) -> None:
        """Release the devices. Safe to call twice."""
        self._session.pulses.discard(self.pulse)
        connected, self._connected = self._connected, []
        for (group, name), each in zip(self._devices.items(), connected, strict=False):
            if self._session.devices.give_back((group, name)):
                each.device.disconnect()

    def recover(self) -> None:
        """Connect lost devices again.

        Raises:
            TeleopError: if one cannot be opened yet.
        """
        for each in self._connected:
            if each.lost:
                each.device.disconnect()
                each.device.connect()
                each.lost = False

    def activate(self, measured: JointReading) -> None:
        """Let all devices start from the measured position; see `Teleop.activate`."""
        for each in self._connected:
            each.device.begin_operation(measured.of(each.columns))
            each.followed = None
            each.device.deadman.disarm(self._session.clock.now_ns())  # reports since the measurement do not count

    def approach(self, measured: JointReading) -> bool:
        """Drive devices with motors to the robot's pose; return whether all have arrived. See `Teleop.approach`.

        Raises:
            TeleopError: if a device has failed.
        """
        return all([each.device.approach(measured.of(each.columns)) for each in self._connected])

    def read(self, measured: JointReading) -> TeleopCommand:
        """The commands of all devices as one, which is finished when all are; an emergency stop is sent to control.

        Raises:
            TeleopError: if a device has failed; names all that have.
        """
        commands, faults = [], []
        for each in self._connected:
            own = measured.of(each.columns)
            each.device.deadman.braking_s = self._braking_s(own, each.columns)
            try:
                commands.append(each.believed(each.device.operate(own), own, self._patience_ns))
            except TeleopError as error:
                each.lost = True
                faults.append(str(error))
        if any(command.estop for command in commands):
            self._session.emergency_stop()
        if faults:
            raise TeleopError("; ".join(faults))
        return TeleopCommand(
            {joint: at for command in commands for joint, at in (command.positions or {}).items()} or None,
            approaching=any(command.approaching for command in commands),
            finished=all(command.finished for command in commands),
            events=tuple(event for command in commands for event in command.events),
        )

    def help(self) -> str:
        """The instructions of all devices, once if two say the same."""
        return "\n".join(dict.fromkeys(filter(None, (each.device.help() for each in self._connected))))

    def _braking_s(self, measured: JointReading, columns: NDArray[np.intp]) -> float:
        """Time that the joints need to stop from their present velocities, and one period [s]."""
        robot = self._session.config.robot
        speed = np.nan_to_num(np.abs(measured.velocity), nan=np.inf)
        slowest = np.minimum(speed, robot.max_velocity[columns]) / robot.max_acceleration[columns]
        return float(slowest.max()) + 1.0 / self._session.config.control.rate_hz

    def _opened(self, name: str, part: Robot) -> Teleop:
        device: Teleop = self._session.make("teleop", self._session.config.teleoperation[name], name, robot=part)
        try:
            device.connect()
        except BaseException:
            device.disconnect()
            raise
        return device
