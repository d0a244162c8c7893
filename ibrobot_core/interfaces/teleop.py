"""Teleoperation devices, with which an operator moves the robot, in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import attrs

from ibrobot_core.deadman import Deadman
from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces.hardware import JointReading

OperatorEvent = Literal["start", "success", "failure", "discard", "intervention"]
"""Requests of an operator to the run, by buttons of the device: begin an episode; end it as a success or a failure, or
discard it; take the robot from the policy, or give it back."""


@attrs.frozen
class TeleopCommand:
    """The operator's command at one instant."""

    positions: Mapping[str, float] | None
    """Joint name -> position [rad]; None while the deadman is released, so that the robot holds.

    Of an executor's joints all or none: if one is missing, the others hold, too. A joint that should rest is commanded
    to where it was at `activate`.
    """
    estop: bool = False
    approaching: bool = False
    """Whether the robot still moves to the device's own pose, and follows it only then."""
    finished: bool = False
    """True if the device has no further commands, e.g. at the end of a recording."""
    events: tuple[OperatorEvent, ...] = ()
    """Requests since the last command, in order; one per press."""


class Teleop(ABC):
    """A device that commands joint positions. Its first positions after `activate` must be those of the robot.

    The run drops positions that `deadman` does not allow.
    """

    operated: ClassVar[bool] = True
    """Whether an operator starts every motion by a deadman. False for a device that moves by itself, e.g. a demo."""

    deadman: Deadman
    """The device's deadman: `read` reports each state of it that the device sends, and moves while it allows."""

    def __new__(cls, *args: object, **kwargs: object) -> Self:
        """Create the device with its deadman here, so that its threads cannot make two."""
        made = super().__new__(cls)
        made.deadman = Deadman()
        return made

    @abstractmethod
    def connect(self) -> None:
        """Open the device.

        Raises:
            TeleopError: e.g. if the port does not exist, or there is no terminal.
        """

    @abstractmethod
    def read(self, measured: JointReading) -> TeleopCommand:
        """The command at `measured.stamp_ns`; called at the control rate; never blocks.

        Args:
            measured: the robot's joints in robot order, for devices that move relative to them.

        Raises:
            TeleopError: if the device is gone or not connected. This is a fault until a reset, which calls `disconnect`
                and `connect`.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Release the device. Safe to call twice."""

    def activate(self, measured: JointReading) -> None:
        """Called when the mode begins and after every reset: start from the measured position.

        `deadman` is disarmed already, so that nothing moves until the operator acts again. An emergency stop that the
        operator has requested is not discarded.
        """

    def approach(self, measured: JointReading) -> bool:
        """Drive the device itself to the robot's pose, if it has motors, and release it there.

        Called at the control rate before `activate` when an operator takes the robot from a policy, until it returns
        True; the robot holds meanwhile. Never blocks.

        Raises:
            TeleopError: as `read`.
        """
        return True

    def help(self) -> str:
        """Instructions for the operator, in a few lines: keys, buttons."""
        return ""

    def begin_operation(self, measured: JointReading) -> None:
        """Activate the device at the measured position, with its deadman disarmed."""
        self.deadman.disarm(measured.stamp_ns)
        self.activate(measured)

    def operate(self, measured: JointReading) -> TeleopCommand:
        """Read its command; positions that its deadman does not allow are left out.

        Raises:
            TeleopError: as `read`, or if the device commands positions and never reports its deadman.
        """
        deadman, now_ns = self.deadman, measured.stamp_ns
        try:
            command = self.read(measured)
        except TeleopError:
            deadman.disarm(now_ns)
            raise
        if command.estop:
            deadman.disarm(now_ns)
        if deadman.allows(now_ns) or deadman.brakes(now_ns) or command.positions is None or not self.operated:
            return command
        if not deadman.reported:
            raise TeleopError(
                f"{type(self).__name__} commands positions without a deadman: its read must call self.deadman.report, "
                "or its class must set operated = False"
            )
        return attrs.evolve(command, positions=None)
