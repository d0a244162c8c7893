"""Hardware: what reads joints and takes position commands; runs in the control process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from enum import Enum

import attrs
import numpy as np

from ibrobot_core.errors import NotSupported
from ibrobot_core.robot import Vector


@attrs.frozen(eq=False)
class JointReading:
    """Measured joints at one instant, in the order of the hardware's joints."""

    stamp_ns: int
    position: Vector
    """[rad], shape (J,)."""
    velocity: Vector
    """[rad/s], shape (J,)."""
    effort: Vector
    """[Nm], shape (J,); NaN where the hardware does not measure it."""
    stale: bool = False
    """True when this repeats the last reading because a single reply was lost."""


@attrs.frozen
class Signal:
    """Numbers that hardware publishes beside its joints, e.g. servo temperatures or a scene's ground truth."""

    topic: str
    size: int
    help: str = ""


class Torque(Enum):
    """What became of the joints' torque after `Hardware.relax`."""

    OFF = "off"
    """The hardware confirmed that every joint's torque is off."""
    UNKNOWN = "unknown"
    """The command was sent, and nothing confirmed it, e.g. because the cable is out: joints may still hold."""


class Severity(Enum):
    """How serious a `Condition` is; the driver's options say where each begins."""

    WARNING = "warning"
    """Logged once when it begins; the robot goes on."""
    FAULT = "fault"
    """Stops the robot by `control.stop`, until a reset."""


@attrs.frozen
class Condition:
    """Something about a joint that is not as it should be, e.g. a servo that is hot."""

    joint: str
    quantity: str
    """What was measured: e.g. temperature, voltage, load, torque."""
    value: float
    unit: str
    """Of `value`, e.g. deg C, V; empty for a ratio or a switch."""
    severity: Severity
    message: str
    """One line: joint, value, limit, and what to do about it."""
    sheds_load: bool = False
    """Whether less load is what helps, as with heat and overload: where it lasts, `control.shed` takes effect."""


@attrs.frozen
class Holding:
    """Torque that stays on when nobody commands the joints any more."""

    where: str
    """E.g. the serial port."""
    command: str
    """What to type to take it off, complete."""


class Hardware(ABC):
    """A group of joints. All methods are called from one thread of the control process; none may block beyond a tick.

    A driver implements `connect`, `read`, `write` and `disconnect`; `relax`, `health`, `holding` and `signals` where
    it can.
    """

    joints: tuple[str, ...]
    """The joints that this hardware owns; the order of all its vectors. Set by the constructor."""
    signals: tuple[Signal, ...] = ()

    @abstractmethod
    def connect(self) -> None:
        """Open and configure; joints hold where they are. Anything not finite or not found is an error here.

        Where it fails, it takes off the torque that it has put on.

        Raises:
            HardwareError: e.g. no such port, or a servo that does not answer.
        """

    @abstractmethod
    def read(self) -> JointReading:
        """Measure all joints, now.

        A lost reply that may be ridden out gives a reading that is `stale`; an error is a fault at once.

        Raises:
            HardwareError: when the hardware does not answer any more, or is not connected.
        """

    @abstractmethod
    def write(self, position: Vector) -> None:
        """Command joint positions [rad], shape (J,), already checked and limited by the safety layer.

        Raises:
            HardwareError: when the hardware does not take them, is not connected, or the shape is wrong.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Release the port. Torque stays as it is. Safe to call twice, and after a failed `connect`."""

    def relax(self) -> Torque:
        """Take torque off; the arm falls. The next `write` puts it back on.

        An error that the joints report meanwhile, e.g. an overload, is no reason to leave torque on.

        Returns:
            Whether the hardware confirmed it.

        Raises:
            HardwareError: when a joint's torque is known to stay on.
            NotSupported: where the hardware has no such thing; `control.stop: relax` is then refused.
        """
        raise NotSupported(f"{type(self).__name__} cannot take torque off")

    def undo_connect(self) -> None:
        """Take off the torque that `connect` put on, because the start failed elsewhere. No joint has moved since.

        By default all torque goes off, where that is supported; joints that held before may go on holding.

        Raises:
            HardwareError: when a joint's torque is known to stay on.
        """
        with suppress(NotSupported):
            self.relax()

    def holding(self) -> Holding | None:
        """What holds torque as far as is known, and how to take it off; None where nothing does.

        Asked after `disconnect` or a failed `connect` too: it answers from memory. Where `relax` was not confirmed,
        joints count as holding.
        """
        return None

    def health(self) -> Sequence[Condition]:
        """What is wrong with the joints at present, at most one condition for each joint and quantity.

        Called in every tick: it answers from memory what a slow read of the hardware found, and raises nothing.
        A condition is in the answer for as long as it lasts; its value may change.
        """
        return ()

    def reset_faults(self) -> None:
        """Clear latched faults so that `read` and `write` may work again. Called on `reset`."""

    def counters(self) -> Mapping[str, int]:
        """What went by so far that a user should know of, e.g. retries; shown on `/diagnostics`."""
        return {}

    def read_signal(self, index: int, out: Vector) -> None:
        """Write the present value of `signals[index]` into `out`, shape (size,)."""
        raise NotImplementedError(f"{type(self).__name__} declares signals but no read_signal")


@attrs.frozen
class EpisodeSetup:
    """What a simulation is set up for: the seed of its random poses."""

    seed: int


class SimulatedHardware(Hardware):
    """Hardware whose time is ours: the loop advances it by exactly one period a tick."""

    @abstractmethod
    def advance(self, step_ns: int) -> None:
        """Advance physics by `step_ns` [ns] under the last command."""

    @abstractmethod
    def reset(self, episode: EpisodeSetup) -> None:
        """Set up the scene again; equal seeds give equal scenes, bit by bit."""

    def success(self) -> bool | None:
        """Whether the scene's task is done; None for a scene without one."""
        return None


def nan_vector(size: int) -> Vector:
    """A vector of NaN, shape (size,): for what is not measured."""
    return np.full(size, np.nan)
