"""Hardware, which reads joints and accepts position commands, in the control process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from enum import Enum, StrEnum
from types import MappingProxyType
from typing import Literal

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import NotSupported
from ibrobot_core.messages import Pose
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
    """[Nm], shape (J,); NaN if the hardware does not measure it."""
    stale: bool = False
    """True if this repeats the last reading because a single reply was lost."""

    def of(self, columns: NDArray[np.intp]) -> JointReading:
        """The reading of some joints, by their indices."""
        values = self.position[columns], self.velocity[columns], self.effort[columns]
        return JointReading(self.stamp_ns, *values, self.stale)


@attrs.frozen
class Signal:
    """Values that hardware publishes in addition to its joints, e.g. servo temperatures or a scene's ground truth."""

    topic: str
    size: int
    help: str = ""


@attrs.frozen
class SceneObject:
    """A rigid object of a simulated scene, as a shape."""

    name: str
    shape: Literal["box", "sphere", "cylinder", "capsule", "plane"]
    """A box, or a cylinder or capsule along z, about its centre; a plane is solid below z = 0."""
    size: tuple[float, ...]
    """Lengths of a box along x, y and z; radius of a sphere; radius and height of a cylinder or capsule (without the
    half spheres); nothing for a plane [m]."""
    pose: Pose
    """Pose at the beginning, in the base frame."""
    topic: str = ""
    """The `Signal` that has its pose during a run; empty for an object that stands still."""
    first: int = 0
    """Index of the pose in that signal: position [m] (3), quaternion wxyz (4)."""
    color: tuple[float, ...] = ()
    """Red, green, blue and opacity, 0 to 1; empty if it has none."""


class Torque(Enum):
    """State of the joints' torque after `Hardware.relax`."""

    OFF = "off"
    """The hardware confirmed that every joint's torque is off."""
    UNKNOWN = "unknown"
    """The command was sent but not confirmed, e.g. because the cable is unplugged: joints may still hold."""


class Severity(StrEnum):
    """Severity of a `Condition`; the driver's options define the levels."""

    WARNING = "warning"
    """Logged once when it begins; the robot continues."""
    FAULT = "fault"
    """Stops the robot as `control.stop` says, until a reset."""


@attrs.frozen
class Condition:
    """An abnormal condition of a joint, e.g. a hot servo."""

    joint: str
    quantity: str
    """The measured quantity, e.g. temperature, voltage, load, torque."""
    value: float
    unit: str
    """Unit of `value`, e.g. deg C, V; empty for a ratio or a switch."""
    severity: Severity
    message: str
    """One line with joint, value, limit and remedy."""
    sheds_load: bool = False
    """Whether a smaller load helps, as with heat and overload; if it lasts, `control.load_shedding` takes effect."""


@attrs.frozen
class Holding:
    """Torque that stays on after the joints are no longer commanded."""

    where: str
    """The place, e.g. the serial port."""
    command: str
    """The complete command that switches it off."""


class Hardware(ABC):
    """A group of joints. All methods are called from one thread of the control process; none may block beyond a tick.

    A driver implements `connect`, `read`, `write` and `disconnect` and, if possible, `relax`, `health`, `holding` and
    `signals`.
    """

    joints: tuple[str, ...]
    """The joints that this hardware owns; the order of all its vectors. Set by the constructor."""
    signals: tuple[Signal, ...] = ()

    @abstractmethod
    def connect(self) -> None:
        """Open and configure the hardware; joints hold their positions. Missing parts and non-finite values are errors.

        If it fails, it switches off the torque that it has switched on.

        Raises:
            HardwareError: e.g. if the port does not exist, or a servo does not answer.
        """

    @abstractmethod
    def read(self) -> JointReading:
        """Measure all joints, now.

        After a lost reply that can be tolerated, the reading is `stale`; an error is a fault at once.

        Raises:
            HardwareError: if the hardware does not answer, or is not connected.
        """

    @abstractmethod
    def write(self, position: Vector) -> None:
        """Command joint positions [rad], shape (J,), already checked and limited by the safety layer.

        Raises:
            HardwareError: if the hardware does not accept them or is not connected, or the shape is wrong.
        """

    @abstractmethod
    def disconnect(self) -> None:
        """Release the port, without changing the torque. Safe to call twice, and after a failed `connect`."""

    def relax(self) -> Torque:
        """Switch the torque off; the arm falls. The next `write` switches it on again.

        Errors that the joints report, e.g. an overload, must not keep the torque on.

        Returns:
            Whether the hardware confirmed it.

        Raises:
            HardwareError: if a joint's torque is known to stay on.
            NotSupported: if the hardware has no torque control; `control.stop: relax` is then refused.
        """
        raise NotSupported(f"{type(self).__name__} cannot switch its torque off")

    def undo_connect(self) -> None:
        """Switch off the torque that `connect` switched on, because the start failed elsewhere. No joint has moved.

        By default, all torque is switched off if that is supported. Joints that held before `connect` may keep holding.

        Raises:
            HardwareError: if a joint's torque is known to stay on.
        """
        with suppress(NotSupported):
            self.relax()

    def holding(self) -> Holding | None:
        """Where torque is on, as far as known, and how to switch it off; None if it is off.

        Also called after `disconnect` or a failed `connect`, so it answers from memory. If `relax` was not confirmed,
        joints count as holding.
        """
        return None

    def health(self) -> Sequence[Condition]:
        """Present abnormal conditions of the joints, at most one per joint and quantity.

        Called in every tick, so it answers from memory, with the result of an earlier slow read, and raises nothing. A
        condition is listed as long as it lasts; its value may change.
        """
        return ()

    def reset_faults(self) -> None:
        """Clear latched faults so that `read` and `write` may work again. Called on `reset`."""

    def counters(self) -> Mapping[str, int]:
        """Counts of events since construction, e.g. retries; shown on `/diagnostics`."""
        return {}

    def read_signal(self, index: int, out: Vector) -> None:
        """Write the present value of `signals[index]` into `out`, shape (size,)."""
        raise NotImplementedError(f"{type(self).__name__} declares signals but no read_signal")


@attrs.frozen
class EpisodeSetup:
    """Set-up of a simulated episode: the seed of its random poses."""

    seed: int


class SimulatedHardware(Hardware):
    """Hardware with simulated time: the loop advances it by exactly one period per tick."""

    factors: Mapping[str, float] = MappingProxyType({})
    """What the present episode has drawn, e.g. the cube's position or the light; see `Scene.factors`."""

    @abstractmethod
    def advance(self, step_ns: int) -> None:
        """Advance physics by `step_ns` [ns] under the last command."""

    @abstractmethod
    def reset(self, episode: EpisodeSetup) -> None:
        """Reset the scene; equal seeds give equal scenes, bit by bit."""

    def success(self) -> bool | None:
        """Whether the scene's task is done; None if it has no task."""
        return None


def nan_vector(size: int) -> Vector:
    """A vector of NaN, shape (size,), for quantities that are not measured."""
    return np.full(size, np.nan)
