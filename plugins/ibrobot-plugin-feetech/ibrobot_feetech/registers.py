"""The control table of the STS3215: addresses, encodings and units of the registers."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Literal

import attrs

MODEL_STS3215 = 777


@attrs.frozen
class Register:
    """One register; values are little-endian."""

    name: str
    address: int
    size: int
    area: Literal["eprom", "ram", "factory"]
    """EPROM keeps its values without power and can be written only while `lock` is 0."""
    unit: str = ""
    writable: bool = True
    sign_bit: int | None = None
    """The sign bit, with the magnitude below it; None for unsigned values."""

    @property
    def limits(self) -> tuple[int, int]:
        """The minimum and maximum value that can be encoded."""
        if self.sign_bit is None:
            return 0, (1 << 8 * self.size) - 1
        magnitude = (1 << self.sign_bit) - 1
        return -magnitude, magnitude

    def encode(self, value: int) -> bytes:
        """The bytes of a value.

        Raises:
            ValueError: if it is out of range.
        """
        least, greatest = self.limits
        if not least <= value <= greatest:
            raise ValueError(f"{self.name} must be {least} to {greatest}, not {value}")
        if value < 0 and self.sign_bit is not None:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, "little")

    def decode(self, content: bytes) -> int:
        """The value of bytes, shape (size,); bits above the sign bit are ignored.

        Raises:
            ValueError: if the number of bytes is wrong.
        """
        if len(content) != self.size:
            raise ValueError(f"{self.name} has {self.size} bytes, not {len(content)}")
        raw = int.from_bytes(content, "little")
        if self.sign_bit is None:
            return raw
        magnitude = raw & ((1 << self.sign_bit) - 1)
        return -magnitude if raw >> self.sign_bit & 1 else magnitude


_TICK, _SPEED = "360/4096 deg", "360/4096 deg/s"

_TABLE = (
    Register("firmware_major", 0, 1, "eprom", writable=False),
    Register("firmware_minor", 1, 1, "eprom", writable=False),
    Register("model_number", 3, 2, "eprom", writable=False),
    Register("id", 5, 1, "eprom"),
    Register("baud_rate", 6, 1, "eprom", "code, 0 = 1 Mbaud"),
    Register("return_delay", 7, 1, "eprom", "2 us"),
    Register("status_return_level", 8, 1, "eprom"),
    Register("min_position_limit", 9, 2, "eprom", _TICK),
    Register("max_position_limit", 11, 2, "eprom", _TICK),
    Register("max_temperature_limit", 13, 1, "eprom", "deg C"),
    Register("max_voltage_limit", 14, 1, "eprom", "0.1 V"),
    Register("min_voltage_limit", 15, 1, "eprom", "0.1 V"),
    Register("max_torque", 16, 2, "eprom", "0.1 %"),
    Register("phase", 18, 1, "eprom"),
    Register("unloading_condition", 19, 1, "eprom", "error bits"),
    Register("led_alarm_condition", 20, 1, "eprom", "error bits"),
    Register("p_coefficient", 21, 1, "eprom"),
    Register("d_coefficient", 22, 1, "eprom"),
    Register("i_coefficient", 23, 1, "eprom"),
    Register("min_startup_force", 24, 2, "eprom", "0.1 %"),
    Register("cw_dead_zone", 26, 1, "eprom", _TICK),
    Register("ccw_dead_zone", 27, 1, "eprom", _TICK),
    Register("protection_current", 28, 2, "eprom", "6.5 mA"),
    Register("angular_resolution", 30, 1, "eprom"),
    Register("homing_offset", 31, 2, "eprom", _TICK, sign_bit=11),
    Register("operating_mode", 33, 1, "eprom"),
    Register("protective_torque", 34, 1, "eprom", "%"),
    Register("protection_time", 35, 1, "eprom", "10 ms"),
    Register("overload_torque", 36, 1, "eprom", "%"),
    Register("velocity_p_coefficient", 37, 1, "eprom"),
    Register("over_current_protection_time", 38, 1, "eprom", "10 ms"),
    Register("velocity_i_coefficient", 39, 1, "eprom"),
    Register("torque_enable", 40, 1, "ram"),
    Register("acceleration", 41, 1, "ram", "100 * 360/4096 deg/s^2"),
    Register("goal_position", 42, 2, "ram", _TICK, sign_bit=15),
    Register("goal_time", 44, 2, "ram"),
    Register("goal_velocity", 46, 2, "ram", _SPEED, sign_bit=15),
    Register("torque_limit", 48, 2, "ram", "0.1 %"),
    Register("lock", 55, 1, "ram"),
    Register("present_position", 56, 2, "ram", _TICK, writable=False, sign_bit=15),
    Register("present_velocity", 58, 2, "ram", _SPEED, writable=False, sign_bit=15),
    Register("present_load", 60, 2, "ram", "0.1 %", writable=False, sign_bit=10),
    Register("present_voltage", 62, 1, "ram", "0.1 V", writable=False),
    Register("present_temperature", 63, 1, "ram", "deg C", writable=False),
    Register("status", 65, 1, "ram", "error bits", writable=False),
    Register("moving", 66, 1, "ram", writable=False),
    Register("present_current", 69, 2, "ram", "6.5 mA", writable=False, sign_bit=15),
    Register("goal_position_2", 71, 2, "ram", _TICK, writable=False),
    Register("moving_velocity_threshold", 80, 1, "factory"),
    Register("dts", 81, 1, "factory", "ms"),
    Register("velocity_unit_factor", 82, 1, "factory"),
    Register("hts", 83, 1, "factory"),
    Register("maximum_velocity_limit", 84, 1, "factory"),
    Register("maximum_acceleration", 85, 1, "factory", "100 * 360/4096 deg/s^2"),
    Register("acceleration_multiplier", 86, 1, "factory"),
)

BAUD_RATES: Mapping[int, int] = {
    1_000_000: 0, 500_000: 1, 250_000: 2, 128_000: 3, 115_200: 4, 57_600: 5, 38_400: 6, 19_200: 7,
}  # fmt: skip
"""Baud rate -> the code of register `baud_rate`."""

STS3215: Mapping[str, Register] = {register.name: register for register in _TABLE}
"""Name -> register, in order of address."""


def register(name: str) -> Register:
    """The register with that name.

    Raises:
        KeyError: if the name is unknown.
    """
    if name in STS3215:
        return STS3215[name]
    close = get_close_matches(name, STS3215, 1)
    hint = f"did you mean {close[0]!r}?" if close else f"available: {', '.join(STS3215)}"
    raise KeyError(f"the STS3215 has no register {name!r}, {hint}")


def writable(name: str) -> Register:
    """The writable register with that name.

    Raises:
        KeyError: if the name is unknown.
        ValueError: if it is read-only.
    """
    field = register(name)
    if not field.writable:
        raise ValueError(f"{name} is read-only")
    return field
