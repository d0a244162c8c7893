"""Guards, which keep commands from leading the robot into itself or the world; they run in the control process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from ibrobot_core.robot import Vector


class Guard(ABC):
    """Called by the safety layer in each tick in which it does not brake, from one thread.

    Attributes:
        overruled: what a changed setpoint of the last tick was about to touch, as JSON: the names `first` and `second`,
            their `distance` [m] when this began, and that in words as `text`; empty if it passed. `/guard` has a
            message for each change.
        counts: counts since construction, by name, for `/diagnostics`.
    """

    overruled: str = ""
    counts: Mapping[str, int] = {}

    @abstractmethod
    def accept(self, position: Vector, velocity: Vector, setpoint: Vector, measured: Vector) -> Vector:
        """The command of this tick [rad], shape (J,), in place of `setpoint`.

        The safety layer brings it between `setpoint`, which is within all limits, and braking. An error of a plugin is
        a fault: the robot brakes, and holds until a reset.

        Args:
            position: the last command [rad], shape (J,).
            velocity: its speed [rad/s], shape (J,).
            setpoint: what the limits permit of the desired positions [rad], shape (J,).
            measured: measured positions [rad], shape (J,); NaN where a joint is not measured.
        """

    @abstractmethod
    def world(self, change: Mapping[str, Any]) -> None:
        """Take in a change of the world, in the words of the guard's own plugin, before the next `accept`.

        Raises:
            HardwareError: if it is malformed; nothing has changed then.
        """
