"""Frames of Damiao motors in MIT mode (DM-J4310-2EC user manual V1.2, sections 7 to 9).

A motor receives on its CAN id and answers on its feedback id ("master id"). Numbers in frames are unsigned integers
that span a range which the motor keeps in its registers, so a driver has to read it from the motor.
"""

from __future__ import annotations

import struct

import attrs

from ibrobot_core.api import HardwareError

DEFAULT_BITRATE = 1_000_000
"""Rate of a motor's bus as it comes [bit/s]."""
REGISTER_ID = 0x7FF
"""CAN id on which every motor listens for requests that name a motor in their data."""
READ, WRITE, SAVE, REFRESH = 0x33, 0x55, 0xAA, 0xCC
"""Requests on `REGISTER_ID`: read a register, write one until power-off, keep all for good, ask for feedback."""
ENABLE, DISABLE, SAVE_ZERO, CLEAR_ERROR = 0xFC, 0xFD, 0xFE, 0xFB
"""Commands on a motor's id: torque on, torque off, the present position is 0 from now on, clear an error."""

FEEDBACK_ID, MOTOR_ID, TIMEOUT, MODE = 7, 8, 9, 10
"""Registers with whole numbers; `TIMEOUT` counts 50 us without a command until the motor switches its torque off."""
MAX_POSITION, MAX_VELOCITY, MAX_TORQUE = 21, 22, 23
"""Registers with the ends of the ranges, as floats [rad], [rad/s], [Nm]."""
WHOLE = (FEEDBACK_ID, MOTOR_ID, TIMEOUT, MODE)
MIT = 1
"""Value of `MODE` for MIT mode."""

MAX_KP, MAX_KD = 500.0, 5.0
"""Ends of the ranges of stiffness [Nm/rad] and damping [Nm s/rad]."""

OFF, ON = 0, 1
"""States of a motor without an error."""
ERRORS = {
    0x8: "over-voltage",
    0x9: "under-voltage",
    0xA: "over-current",
    0xB: "over-temperature of the driver",
    0xC: "over-temperature of the coil",
    0xD: "loss of communication",
    0xE: "overload",
}
"""States that are errors; the motor has switched its torque off."""


def quantised(value: float, least: float, greatest: float, bits: int) -> int:
    """A number as an unsigned integer of some bits that spans `least` to `greatest`; beyond these, the nearest end."""
    top = (1 << bits) - 1
    return round((min(max(value, least), greatest) - least) / (greatest - least) * top)


def measured(number: int, least: float, greatest: float, bits: int) -> float:
    """The number that an unsigned integer of some bits stands for."""
    return least + number * (greatest - least) / ((1 << bits) - 1)


@attrs.frozen
class Ranges:
    """What the integers in a motor's frames span: from -x to x."""

    position: float
    """[rad]"""
    velocity: float
    """[rad/s]"""
    torque: float
    """[Nm]"""


@attrs.frozen
class MitCommand:
    """The motor's torque is `kp * (position - p) + kd * (velocity - v) + torque`, where it is at p and moves with v."""

    position: float
    """[rad]"""
    kp: float
    """[Nm/rad], 0 to 500"""
    kd: float
    """[Nm s/rad], 0 to 5"""
    velocity: float = 0.0
    """[rad/s]"""
    torque: float = 0.0
    """[Nm]"""

    def encode(self, ranges: Ranges) -> bytes:
        """The 8 bytes of the frame on the motor's id."""
        position = quantised(self.position, -ranges.position, ranges.position, 16)
        velocity = quantised(self.velocity, -ranges.velocity, ranges.velocity, 12)
        kp, kd = quantised(self.kp, 0.0, MAX_KP, 12), quantised(self.kd, 0.0, MAX_KD, 12)
        torque = quantised(self.torque, -ranges.torque, ranges.torque, 12)
        return (position << 48 | velocity << 36 | kp << 24 | kd << 12 | torque).to_bytes(8)

    @classmethod
    def decode(cls, data: bytes, ranges: Ranges) -> MitCommand:
        """The command in 8 bytes."""
        bits = int.from_bytes(data)
        return cls(
            position=measured(bits >> 48, -ranges.position, ranges.position, 16),
            velocity=measured(bits >> 36 & 0xFFF, -ranges.velocity, ranges.velocity, 12),
            kp=measured(bits >> 24 & 0xFFF, 0.0, MAX_KP, 12),
            kd=measured(bits >> 12 & 0xFFF, 0.0, MAX_KD, 12),
            torque=measured(bits & 0xFFF, -ranges.torque, ranges.torque, 12),
        )


@attrs.frozen
class Feedback:
    """What a motor answers to every command and to `refresh`."""

    motor: int
    """The lower four bits of its id."""
    state: int
    """`OFF`, `ON`, or one of `ERRORS`."""
    position: float
    """[rad]"""
    velocity: float
    """[rad/s]"""
    torque: float
    """[Nm]"""
    driver: float
    """Temperature of the driver's transistors [deg C]."""
    coil: float
    """Temperature of the coil [deg C]."""

    def encode(self, ranges: Ranges) -> bytes:
        """The 8 bytes of the frame on the feedback id."""
        position = quantised(self.position, -ranges.position, ranges.position, 16)
        velocity = quantised(self.velocity, -ranges.velocity, ranges.velocity, 12)
        torque = quantised(self.torque, -ranges.torque, ranges.torque, 12)
        head = self.state << 4 | self.motor & 0xF
        bits = head << 56 | position << 40 | velocity << 28 | torque << 16
        return (bits | quantised(self.driver, 0, 255, 8) << 8 | quantised(self.coil, 0, 255, 8)).to_bytes(8)

    @classmethod
    def decode(cls, data: bytes, ranges: Ranges) -> Feedback:
        """The feedback in 8 bytes.

        Raises:
            HardwareError: if there are not 8 bytes, or the state is none.
        """
        if len(data) != 8:
            raise HardwareError(f"feedback has 8 bytes, not {len(data)}: {data.hex(' ')}")
        bits = int.from_bytes(data)
        state = bits >> 60
        if state not in (OFF, ON, *ERRORS):
            raise HardwareError(f"{state} is no state of a motor: {data.hex(' ')}")
        return cls(
            motor=bits >> 56 & 0xF,
            state=state,
            position=measured(bits >> 40 & 0xFFFF, -ranges.position, ranges.position, 16),
            velocity=measured(bits >> 28 & 0xFFF, -ranges.velocity, ranges.velocity, 12),
            torque=measured(bits >> 16 & 0xFFF, -ranges.torque, ranges.torque, 12),
            driver=float(bits >> 8 & 0xFF),
            coil=float(bits & 0xFF),
        )


def command(code: int) -> bytes:
    """The frame of `ENABLE`, `DISABLE`, `SAVE_ZERO` or `CLEAR_ERROR`."""
    return b"\xff" * 7 + bytes([code])


def refresh(motor: int) -> bytes:
    """The frame on `REGISTER_ID` that asks a motor for feedback and changes nothing."""
    return struct.pack("<HBB4x", motor, REFRESH, 0)


def save(motor: int) -> bytes:
    """The frame on `REGISTER_ID` that makes a motor, whose torque is off, keep its registers after power-off."""
    return struct.pack("<HBB4x", motor, SAVE, 1)


@attrs.frozen
class Register:
    """A register in a request to read or write it, or in the answer to one."""

    motor: int
    register: int
    value: float = 0
    write: bool = False

    def encode(self) -> bytes:
        """The 8 bytes of the frame on `REGISTER_ID`, or of the answer on the feedback id."""
        kind = "I" if self.register in WHOLE else "f"
        number = int(self.value) if self.register in WHOLE else self.value
        return struct.pack(f"<HBB{kind}", self.motor, WRITE if self.write else READ, self.register, number)

    @classmethod
    def decode(cls, data: bytes) -> Register | None:
        """The register in 8 bytes; None if they are something else."""
        if len(data) != 8 or data[2] not in (READ, WRITE):
            return None
        kind = "I" if data[3] in WHOLE else "f"
        motor, code, register, value = struct.unpack(f"<HBB{kind}", data)
        return cls(motor, register, value, code == WRITE)
