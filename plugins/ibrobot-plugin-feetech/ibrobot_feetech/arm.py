"""The servos of one arm: their joints, zeros and configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import attrs
import numpy as np
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_calibration.plausibility import oddities
from numpy.typing import NDArray

from ibrobot_core.api import HardwareError, Vector
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.calibration import ZERO_AT
from ibrobot_feetech.errors import FeetechError, NoReply, TorqueStaysOn
from ibrobot_feetech.registers import MODEL_STS3215
from ibrobot_feetech.supply import check_supply
from ibrobot_feetech.ticks import TICKS_PER_RADIAN

_LAST_TICK = 4095
_ANGLE_BEYOND_A_TURN = 0x10
"""Bit of `phase` that allows reported positions outside 0 to 4095."""


@attrs.frozen(slots=False)
class Arm:
    """Joints and their servos, in the order of all vectors.

    Args:
        joints: joint names.
        calibration: a calibration of all these joints.
        closed: joint -> angle at its calibrated closed end [rad], for joints that are anchored there.
    """

    joints: tuple[str, ...]
    calibration: Calibration
    closed: Mapping[str, float] = attrs.field(factory=dict)

    @cached_property
    def servos(self) -> tuple[int, ...]:
        """Ids."""
        return tuple(self._of(joint).id for joint in self.joints)

    @cached_property
    def names(self) -> dict[int, str]:
        """Servo id -> joint."""
        return dict(zip(self.servos, self.joints, strict=True))

    @property
    def zero_text(self) -> str:
        """Where 0 rad is, in words."""
        return f"by {self.calibration.path}, 0 rad is {ZERO_AT[self.calibration.zero_at]}"

    @cached_property
    def _zero(self) -> Vector:
        return np.array([self._of(joint).zero(self.closed.get(joint)) for joint in self.joints])

    @cached_property
    def _limits(self) -> tuple[Vector, Vector]:
        each = [self._of(joint) for joint in self.joints]
        return np.array([float(c.range_min) for c in each]), np.array([float(c.range_max) for c in each])

    @cached_property
    def sign(self) -> Vector:
        """1, or -1 where radians decrease as ticks increase; shape (J,)."""
        return np.array([-1.0 if self._of(joint).inverted else 1.0 for joint in self.joints])

    def radians(self, ticks: Vector) -> Vector:
        """Reported positions [ticks] -> joint positions [rad], shape (J,)."""
        radians: Vector = (ticks - self._zero) * self.sign / TICKS_PER_RADIAN
        return radians

    def ticks(self, radians: Vector) -> NDArray[np.intp]:
        """Joint positions [rad] -> goals [ticks], shape (J,), within the calibrated ranges."""
        return np.clip(self.positions(radians), *self._limits).astype(np.intp)

    def positions(self, radians: Vector) -> NDArray[np.intp]:
        """Joint positions [rad] -> reported positions [ticks], shape (J,), not limited to the calibrated ranges."""
        return np.rint(radians * self.sign * TICKS_PER_RADIAN + self._zero).astype(np.intp)

    def reach(self) -> tuple[Vector, Vector]:
        """Lower and upper ends of the calibrated ranges [rad], each shape (J,)."""
        ends = [self.radians(limit) for limit in self._limits]
        return np.minimum(*ends), np.maximum(*ends)

    def oddities(self, limits: Mapping[str, tuple[float, float]]) -> Iterator[str]:
        """What is odd about the calibration; `limits` has those of the joints [rad] that ranges are compared with."""
        for joint in self.joints:
            numbers = {**attrs.asdict(self._of(joint)), "closed_at": self.closed.get(joint)}
            yield from oddities(joint, numbers, limits.get(joint))

    def _of(self, joint: str) -> JointCalibration:
        return self.calibration.joints[joint]


@attrs.frozen
class Tuning:
    """Register values of an arm's servos, in addition to the calibration."""

    registers: Mapping[str, int]
    """Register -> value, for all servos."""
    special: Mapping[str, Mapping[str, int]] = attrs.field(factory=dict)
    """Joint -> registers that differ for this joint."""


def find_servos(bus: FeetechBus, arm: Arm) -> None:
    """Check that every servo answers, has the right model, and that all have one firmware.

    Raises:
        FeetechError: if servos are missing; names all of them.
        HardwareError: if a servo is another model, firmware versions differ, or a servo has the wrong supply voltage.
    """
    missing, firmware = [], {}
    for servo in arm.servos:
        try:
            model = bus.read_faulty(servo, "model_number")
        except NoReply as error:
            missing.append(servo)
            last = error
            continue
        if model != MODEL_STS3215:
            problem = f"it is model {model}; an STS3215 is {MODEL_STS3215}"
            raise HardwareError(f"{bus.place(servo, 'model_number')}: {problem}; check that it is the right arm")
        firmware[servo] = bus.firmware(servo)
        check_supply(bus, servo)
    if len(missing) > 1:
        names = ", ".join(f"{servo} ({arm.names[servo]})" for servo in missing)
        raise NoReply(bus.place(), f"no reply from servos {names}")
    if missing:
        raise last
    if len(set(firmware.values())) > 1:
        versions = ", ".join(f"{arm.names[servo]} {version}" for servo, version in firmware.items())
        raise HardwareError(f"{bus.port.path}: the servos have different firmware: {versions}; update the older ones")


def calibration_differences(bus: FeetechBus, arm: Arm) -> list[tuple[int, str, int, int]]:
    """Differences between servos and file, as (servo, register, value in the servo, value in the file).

    Raises:
        FeetechError: if a servo does not answer.
    """
    differences = []
    for servo in arm.servos:
        for name, value in calibrated_registers(arm.calibration.joints[arm.names[servo]]).items():
            if (stored := bus.read_faulty(servo, name)) != value:
                differences.append((servo, name, stored, value))
    return differences


def write_calibration(bus: FeetechBus, arm: Arm, servos: Sequence[int] | None = None) -> None:
    """Write the file's calibration to the servos, which switches their torque off.

    Raises:
        FeetechError: if a servo does not accept it.
    """
    for servo in arm.servos if servos is None else servos:
        write_eprom(bus, servo, calibrated_registers(arm.calibration.joints[arm.names[servo]]))


def write_eprom(bus: FeetechBus, servo: int, values: Mapping[str, int]) -> None:
    """Switch a servo's torque off, set registers of its EPROM, and read them back.

    Raises:
        FeetechError: if a register did not keep its value.
    """
    bus.write(servo, "torque_enable", 0, faulty=True)
    bus.write(servo, "lock", 0, faulty=True)
    try:
        for name, value in values.items():
            bus.write(servo, name, value, faulty=True)
    finally:
        bus.write(servo, "lock", 1, faulty=True)
    for name, value in values.items():
        if (stored := bus.read_faulty(servo, name)) != value:
            raise FeetechError(bus.place(servo, name), f"it was set to {value} and reads {stored}")


def set_up(bus: FeetechBus, arm: Arm, tuning: Tuning, servo: int, *, torque: bool = True) -> None:
    """Configure a servo: torque off, unlock, set its registers, lock, and with `torque`, hold the joint where it is.

    Errors that the servo reports meanwhile are ignored, because switching the torque off clears some of them.

    Raises:
        FeetechError: if a register did not keep its value.
    """
    bus.write(servo, "torque_enable", 0, faulty=True)
    bus.write(servo, "lock", 0, faulty=True)
    phase = bus.read_faulty(servo, "phase")
    if phase & _ANGLE_BEYOND_A_TURN:
        bus.write(servo, "phase", phase & ~_ANGLE_BEYOND_A_TURN, faulty=True)
    for name, value in {**tuning.registers, **tuning.special.get(arm.names[servo], {})}.items():
        bus.write(servo, name, value, faulty=True)
    bus.write(servo, "lock", 1, faulty=True)
    if torque:
        hold(bus, servo)


def hold(bus: FeetechBus, servo: int) -> None:
    """Switch the torque on, with the goal at the present position, so that the joint does not jump.

    Raises:
        FeetechError: if the servo does not answer, or its position is beyond one turn.
    """
    position = bus.read(servo, "present_position")
    if not 0 <= position <= _LAST_TICK:
        raise FeetechError(
            bus.place(servo, "present_position"), f"its position is {position}, beyond one turn (0 to {_LAST_TICK})"
        )
    bus.write(servo, "goal_position", position)
    bus.write(servo, "torque_enable", 1)


def relax(bus: FeetechBus, servos: Sequence[int]) -> None:
    """Switch the torque of all servos off at once and confirm it, even if they report errors.

    Raises:
        TorqueStaysOn: if a servo reports that its torque is still on; names it.
        FeetechError: if a servo did not confirm it, or the port is gone; names the servo or port.
    """
    last: FeetechError | None = None
    for _ in range(bus.retries + 1):
        bus.sync_write("torque_enable", dict.fromkeys(servos, 0))
        try:
            on = [servo for servo, value in bus.sync_read("torque_enable", servos, faulty=True).items() if value]
        except NoReply as error:
            last = error
            continue
        if not on:
            return
        last = TorqueStaysOn(bus.place(on[0], "torque_enable"), "its torque stays on")
    assert last is not None
    raise last


def calibrated_registers(joint: JointCalibration) -> dict[str, int]:
    """Register -> value that the calibration of a joint sets."""
    return {
        "homing_offset": joint.homing_offset,
        "min_position_limit": joint.range_min,
        "max_position_limit": joint.range_max,
    }
