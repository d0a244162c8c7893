"""Teleoperation devices, with which an operator moves the robot, in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Literal

import attrs

from ibrobot_core.deadman import Deadman
from ibrobot_core.interfaces.hardware import JointReading

OperatorEvent = Literal["start", "success", "failure", "discard", "intervention"]
"""Requests of an operator to the run, by buttons of the device: begin an episode; end it as a success or a failure, or
discard it; take the robot from the policy, or give it back."""


@attrs.frozen
class TeleopCommand:
    """The operator's command at one instant."""

    positions: Mapping[str, float] | None
    """Joint name -> position [rad]; None while the deadman is released, so that the robot holds."""
    estop: bool = False
    finished: bool = False
    """True if the device has no further commands, e.g. at the end of a recording."""
    events: tuple[OperatorEvent, ...] = ()
    """Requests since the last command, in order; one per press."""


class Teleop(ABC):
    """A device that commands joint positions. Its first positions after `activate` must be those of the robot."""

    @cached_property
    def deadman(self) -> Deadman:
        """The device's deadman, to which it reports; it moves the robot only while this allows it."""
        return Deadman()

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

        Nothing moves until the operator acts again: a deadman that was pressed before counts as released.
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
