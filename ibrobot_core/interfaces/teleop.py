"""Teleoperation devices: what a person moves so that the robot moves; runs in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Literal

import attrs

from ibrobot_core.interfaces.hardware import JointReading

OperatorEvent = Literal["start", "success", "failure", "discard", "intervention"]
"""What an operator asks of the run by a button of the device: begin an episode; end it as a success, as a failure, or
leave nothing of it; take the robot from the policy, or give it back."""


@attrs.frozen
class TeleopCommand:
    """What the operator asks for at this instant."""

    positions: Mapping[str, float] | None
    """Joint name -> position [rad]; None while the deadman is released, and the robot holds."""
    estop: bool = False
    finished: bool = False
    """True when the device has nothing more to give, e.g. the end of a recording."""
    events: tuple[OperatorEvent, ...] = ()
    """What the operator asked for since the last command, in order; each press once."""


class Teleop(ABC):
    """A device that gives joint positions. Its first positions after `activate` must be where the robot is."""

    @abstractmethod
    def connect(self) -> None:
        """Open the device.

        Raises:
            TeleopError: e.g. no such port, or no terminal.
        """

    @abstractmethod
    def read(self, measured: JointReading) -> TeleopCommand:
        """The command at `measured.stamp_ns`; called at the control rate; never blocks.

        Args:
            measured: the robot's joints in robot order, for devices that move relative to them.

        Raises:
            TeleopError: when the device is gone or not connected; a fault, until a reset after which `disconnect` and
                `connect` have brought it back.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Release the device. Safe to call twice."""

    def activate(self, measured: JointReading) -> None:
        """Called when the mode begins and after every reset: start from the measured position.

        Nothing moves until the operator acts again: a deadman that was pressed before counts as released.
        """

    def help(self) -> str:
        """What an operator must know, in a line or a few: keys, buttons."""
        return ""
