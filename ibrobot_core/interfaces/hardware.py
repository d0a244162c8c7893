"""Hardware: what reads joints and takes position commands; runs in the control process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

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


class Hardware(ABC):
    """A group of joints. All methods are called from one thread of the control process; none may block beyond a tick.

    A driver implements `connect`, `read`, `write` and `disconnect`; `relax` and `signals` where it can.
    """

    joints: tuple[str, ...]
    """The joints that this hardware owns; the order of all its vectors. Set by the constructor."""
    signals: tuple[Signal, ...] = ()

    @abstractmethod
    def connect(self) -> None:
        """Open and configure; joints hold where they are. Anything not finite or not found is an error here.

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

    def relax(self) -> None:
        """Take torque off; the arm falls. The next `write` puts it back on.

        Raises:
            NotSupported: where the hardware has no such thing; `control.stop: relax` is then refused.
        """
        raise NotSupported(f"{type(self).__name__} cannot take torque off")

    def reset_faults(self) -> None:
        """Clear latched faults so that `read` and `write` may work again. Called on `reset`."""

    def counters(self) -> Mapping[str, int]:
        """What went by so far that a user should know of, e.g. retries; shown on `/diagnostics`."""
        return {}

    def read_signal(self, index: int, out: Vector) -> None:
        """Write the present value of `signals[index]` into `out`, shape (size,)."""
        raise NotImplementedError(f"{type(self).__name__} declares signals but no read_signal")


@attrs.frozen
class Episode:
    """What a simulation is set up for: the seed of its random poses."""

    seed: int


class SimulatedHardware(Hardware):
    """Hardware whose time is ours: the loop advances it by exactly one period a tick."""

    @abstractmethod
    def advance(self, step_ns: int) -> None:
        """Advance physics by `step_ns` [ns] under the last command."""

    @abstractmethod
    def reset(self, episode: Episode) -> None:
        """Set the scene up anew; equal seeds give equal scenes, bit by bit."""

    def success(self) -> bool | None:
        """Whether the scene's task is done; None for a scene without one."""
        return None


def nan_vector(size: int) -> Vector:
    """A vector of NaN, shape (size,): for what is not measured."""
    return np.full(size, np.nan)
