"""The servos of one arm: which joint each is, where its zero lies, and how it is set up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import (
    ZERO_AT,
    Calibration,
    HardwareError,
    JointCalibration,
    Vector,
    radians_to_ticks,
    ticks_to_radians,
)
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.errors import FeetechError, NoReply, TorqueStaysOn
from ibrobot_feetech.registers import MODEL_STS3215
from ibrobot_feetech.supply import check_supply

_LAST_TICK = 4095
_ANGLE_BEYOND_A_TURN = 0x10
"""Bit of `phase` that lets the reported position leave 0 to 4095."""


@attrs.frozen(slots=False)
class Arm:
    """Joints and their servos, in the order of all vectors.

    Args:
        joints: names.
        calibration: has every one of them.
        closed: joint -> its angle at its calibrated closed end [rad], for those that are anchored there.
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
    def _inverted(self) -> NDArray[np.bool_]:
        return np.array([self._of(joint).inverted for joint in self.joints])

    @cached_property
    def _limits(self) -> tuple[Vector, Vector]:
        each = [self._of(joint) for joint in self.joints]
        return np.array([float(c.range_min) for c in each]), np.array([float(c.range_max) for c in each])

    @cached_property
    def sign(self) -> Vector:
        """1, or -1 where radians fall while ticks grow; shape (J,)."""
        signs: Vector = np.where(self._inverted, -1.0, 1.0)
        return signs

    def radians(self, ticks: Vector) -> Vector:
        """Reported positions [ticks] -> joint positions [rad], shape (J,)."""
        return ticks_to_radians(ticks, zero=self._zero, inverted=self._inverted)

    def ticks(self, radians: Vector) -> NDArray[np.intp]:
        """Joint positions [rad] -> goals [ticks], shape (J,), within the calibrated ranges."""
        return np.clip(self.positions(radians), *self._limits).astype(np.intp)

    def positions(self, radians: Vector) -> NDArray[np.intp]:
        """Joint positions [rad] -> reported positions [ticks], shape (J,), wherever they lie."""
        return np.rint(radians_to_ticks(radians, zero=self._zero, inverted=self._inverted)).astype(np.intp)

    def reach(self) -> tuple[Vector, Vector]:
        """Lower and upper ends of the calibrated ranges [rad], each shape (J,)."""
        ends = [self.radians(limit) for limit in self._limits]
        return np.minimum(*ends), np.maximum(*ends)

    def _of(self, joint: str) -> JointCalibration:
        return self.calibration.joints[joint]


@attrs.frozen
class Tuning:
    """What every servo of an arm is set to, beside its calibration."""

    registers: Mapping[str, int]
    """Register -> value, for all servos."""
    special: Mapping[str, Mapping[str, int]] = attrs.field(factory=dict)
    """Joint -> registers of its own."""


def find_servos(bus: FeetechBus, arm: Arm) -> None:
    """Check that every servo answers, has the right model, and that all have one firmware.

    Raises:
        FeetechError: names all servos that are missing, or the one that is another model.
        HardwareError: for firmwares that differ, and a supply that a servo is not made for.
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
            found = f"it is model {model}, an STS3215 is {MODEL_STS3215}"
            raise HardwareError(f"{bus.place(servo, 'model_number')}: {found}; check that it is the right arm")
        major, minor = (bus.read_faulty(servo, f"firmware_{part}") for part in ("major", "minor"))
        firmware[servo] = f"{major}.{minor}"
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
    """Where the servos' own calibration is another: servo, register, its value, the file's.

    Raises:
        FeetechError: when a servo does not answer.
    """
    differences = []
    for servo in arm.servos:
        for name, value in _calibrated(arm, servo).items():
            if (found := bus.read_faulty(servo, name)) != value:
                differences.append((servo, name, found, value))
    return differences


def write_calibration(bus: FeetechBus, arm: Arm, servos: Sequence[int] | None = None) -> None:
    """Write the file's calibration to the servos; their torque goes off.

    Raises:
        FeetechError: when a servo does not take it.
    """
    for servo in arm.servos if servos is None else servos:
        write_eprom(bus, servo, _calibrated(arm, servo))


def write_eprom(bus: FeetechBus, servo: int, values: Mapping[str, int]) -> None:
    """Set registers of a servo's EPROM, torque off, and see that it kept them.

    Raises:
        FeetechError: when it did not take one.
    """
    bus.write(servo, "torque_enable", 0, faulty=True)
    bus.write(servo, "lock", 0, faulty=True)
    try:
        for name, value in values.items():
            bus.write(servo, name, value, faulty=True)
    finally:
        bus.write(servo, "lock", 1, faulty=True)
    for name, value in values.items():
        if (found := bus.read_faulty(servo, name)) != value:
            raise FeetechError(bus.place(servo, name), f"it was set to {value} and reads {found}")


def set_up(bus: FeetechBus, arm: Arm, tuning: Tuning, servo: int, *, torque: bool = True) -> None:
    """Set one servo up: torque off, unlock, its registers, lock, and with `torque` on again where the joint stands.

    Errors that it reports meanwhile are accepted: taking torque off is what ends some of them.

    Raises:
        FeetechError: when it does not take a register.
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
    """Torque on, with the goal where the joint stands, so that nothing jumps.

    Raises:
        FeetechError: when the servo does not answer, or stands beyond one turn.
    """
    position = bus.read(servo, "present_position")
    if not 0 <= position <= _LAST_TICK:
        raise FeetechError(
            bus.place(servo, "present_position"), f"it stands at {position}, beyond one turn (0 to {_LAST_TICK})"
        )
    bus.write(servo, "goal_position", position)
    bus.write(servo, "torque_enable", 1)


def relax(bus: FeetechBus, servos: Sequence[int]) -> None:
    """Torque off, on all servos at once, and see that it is; errors that they report are no reason to leave it on.

    Raises:
        TorqueStaysOn: naming a servo that says so.
        FeetechError: naming one that did not say whether it is off, or a port that is gone.
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


def _calibrated(arm: Arm, servo: int) -> dict[str, int]:
    """The registers that calibration sets."""
    joint = arm.calibration.joints[arm.names[servo]]
    return {
        "homing_offset": joint.homing_offset,
        "min_position_limit": joint.range_min,
        "max_position_limit": joint.range_max,
    }
