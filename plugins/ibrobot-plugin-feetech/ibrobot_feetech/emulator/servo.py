"""An emulated STS3215: its control table, its EPROM lock, and a joint that follows its goal."""

from __future__ import annotations

import math

from ibrobot_feetech.emulator.mechanics import FREE_SPEED, Mechanics
from ibrobot_feetech.registers import MODEL_STS3215, STS3215, Register, register

TURN = 4096
"""Ticks per turn."""
_LOCK = register("lock").address
_EPROM_END = register("torque_enable").address
_TORQUE = register("torque_enable").address
_MIDDLE = 128
"""Writing it to `torque_enable` makes the present position the middle of the turn."""
_WHEEL = 1
"""Operating mode in which the servo turns at its goal velocity."""
_DUTY_PER_TICK = 8.0
"""Duty cycle per tick between goal and joint, with a P coefficient of 32 [0.1 %]."""
_PUSH_S = 0.005
"""How often a servo with mechanics computes its duty cycle [s]."""
_AMPERE = 0.0065
"""Unit of `present_current` [A]."""
_UNDERVOLTAGE, _OVERHEATING, _OVERLOAD = 0x01, 0x04, 0x20
_MEASURED = ("present_voltage", "present_temperature")

_DEFAULTS = {
    "firmware_major": 3,
    "firmware_minor": 10,
    "model_number": MODEL_STS3215,
    "return_delay": 250,
    "status_return_level": 1,
    "max_position_limit": 4095,
    "max_temperature_limit": 70,
    "max_voltage_limit": 140,
    "min_voltage_limit": 40,
    "max_torque": 1000,
    "phase": 12,
    "unloading_condition": 44,
    "led_alarm_condition": 47,
    "p_coefficient": 32,
    "d_coefficient": 32,
    "min_startup_force": 16,
    "cw_dead_zone": 1,
    "ccw_dead_zone": 1,
    "protection_current": 500,
    "angular_resolution": 1,
    "protective_torque": 20,
    "protection_time": 200,
    "overload_torque": 80,
    "velocity_p_coefficient": 10,
    "over_current_protection_time": 200,
    "velocity_i_coefficient": 10,
    "torque_limit": 1000,
    "lock": 1,
    "present_voltage": 121,
    "present_temperature": 28,
    "maximum_acceleration": 254,
}


class EmulatedServo:
    """One servo. The caller passes in time with `advance`, which moves the joint; nothing sleeps.

    The table holds raw values, as in the servo; positions are the encoder's minus the homing offset.

    Args:
        servo: servo id.
        encoder: initial position of the joint [ticks], 0 to 4095.
    """

    def __init__(self, servo: int, encoder: float = 2048.0) -> None:
        self.table = bytearray(256)
        for name, value in _DEFAULTS.items():
            self.set(name, value)
        self.set("id", servo)
        self._eprom = bytes(self.table[:_EPROM_END])
        self.encoder = encoder
        """Position of the joint [ticks], without the homing offset."""
        self.velocity = 0.0
        """[ticks/s]"""
        self.blocked = False
        """Whether the joint is blocked."""
        self.burdened = False
        """Whether the motor is under maximum load, independent of the goal."""
        self.mechanics: Mechanics | None = None
        """The forces on the joint; None for a joint that follows its goal, whatever is in its way."""
        self._profile = encoder
        """Where the servo's own profile is on its way to the goal [encoder ticks], with mechanics."""
        self._driven = False
        self._heavy_s = 0.0
        self._overload = False
        self.errors = 0
        """Injected error bits."""
        self._prepared: tuple[int, bytes] | None = None
        self._publish()
        self.set("goal_position", self.get("present_position"))

    @property
    def id(self) -> int:
        """Its id in the table."""
        return self.table[STS3215["id"].address]

    @property
    def error(self) -> int:
        """The error byte of its replies."""
        return self.get("status")

    @property
    def torque(self) -> bool:
        """Whether the motor is on."""
        return self.table[_TORQUE] == 1

    def get(self, name: str) -> int:
        """The decoded value of a register."""
        field = register(name)
        return field.decode(bytes(self.table[field.address : field.address + field.size]))

    def set(self, name: str, value: int) -> None:
        """Set a register, even if it is read-only or locked."""
        field = register(name)
        self.table[field.address : field.address + field.size] = field.encode(value)

    def turn(self, encoder: float) -> None:
        """Move the joint by hand to an encoder position [ticks]; only with torque off.

        Raises:
            ValueError: if the torque is on.
        """
        if self.torque:
            raise ValueError(f"servo {self.id} has torque on: it cannot be turned by hand")
        self.encoder, self.velocity, self._profile = encoder, 0.0, encoder
        self._publish()

    def drive(self, encoder: float, velocity: float) -> None:
        """Set position and velocity from external physics [ticks, ticks/s], which alone moves the joint from now on."""
        self._driven = True
        self.encoder, self.velocity = encoder, velocity
        self._publish()

    def read(self, address: int, size: int) -> bytes:
        """Bytes of the table."""
        return bytes(self.table[address : address + size])

    def write(self, address: int, content: bytes) -> None:
        """Write as a host does: read-only registers and locked EPROM keep their values."""
        for offset, value in enumerate(content):
            self._write_byte(address + offset, value)
        touched = range(address, address + len(content))
        if _TORQUE in touched and self.table[_TORQUE] == _MIDDLE:
            self._make_middle()
        if self.table[_LOCK] == 0:
            self._eprom = bytes(self.table[:_EPROM_END])
        self._publish()

    def prepare(self, address: int, content: bytes) -> None:
        """Store a write until `act`."""
        self._prepared = address, content

    def act(self) -> None:
        """Execute the prepared write."""
        if self._prepared is not None:
            prepared, self._prepared = self._prepared, None
            self.write(*prepared)

    def brown_out(self) -> None:
        """Lose power for a moment: RAM and torque are lost, EPROM is kept."""
        measured = {name: self.get(name) for name in _MEASURED}
        self.table[:] = EmulatedServo(self.id, self.encoder).table
        self.table[:_EPROM_END] = self._eprom
        for name, value in measured.items():
            self.set(name, value)
        self.set("torque_limit", self.get("max_torque"))
        self.velocity, self._prepared, self._profile = 0.0, None, self.encoder
        self.advance(0.0)
        self.set("goal_position", self.get("present_position"))

    def advance(self, elapsed_s: float) -> None:
        """Advance by `elapsed_s` [s]: the joint moves towards its goal, and lasting high load causes an overload."""
        if self.mechanics is not None and not self._driven:
            self._pushed(self.mechanics, elapsed_s)
        elif not self._driven:
            mode = self.get("operating_mode") if self.torque and not self.blocked else None
            if mode == 0:
                self._follow(elapsed_s)
            else:
                self.velocity = float(self.get("goal_velocity")) if mode == _WHEEL else 0.0
                self.encoder += self.velocity * elapsed_s
        self._protect(elapsed_s)
        self._publish()

    @property
    def goal(self) -> float:
        """The motor's goal [encoder ticks], within the limits of its table."""
        low, high = self.get("min_position_limit"), self.get("max_position_limit")
        goal = self.get("goal_position")
        if low < high:
            goal = min(max(goal, low), high)
        return goal + self.get("homing_offset")

    def _follow(self, elapsed_s: float) -> None:
        """Move towards the goal with a trapezoidal velocity profile; the timing of the end is approximate."""
        way = self._way()
        if abs(way) < 0.5 and abs(self.velocity) < 50:
            self.encoder, self.velocity = self.encoder + way, 0.0
            return
        top = float(min(abs(self.get("goal_velocity")) or FREE_SPEED, FREE_SPEED))
        acceleration = 100.0 * (self.table[register("acceleration").address] or 254)
        remaining = elapsed_s
        step_s = 0.001
        while remaining > 1e-9:
            step = min(step_s, remaining)
            remaining -= step
            way = self._way()
            wanted = math.copysign(min(top, math.sqrt(2 * acceleration * abs(way)), abs(way) / step), way)
            change = min(max(wanted - self.velocity, -acceleration * step), acceleration * step)
            self.velocity += change
            moved = self.velocity * step
            if abs(moved) >= abs(way) and moved * way > 0 and abs(self.velocity) <= acceleration * step * 2:
                self.encoder, self.velocity = self.encoder + way, 0.0
                return
            self.encoder += moved

    def _pushed(self, mechanics: Mechanics, elapsed_s: float) -> None:
        """Move as the motor and the forces on the joint make it, in short steps."""
        if not self.torque and mechanics.supported:
            self.velocity, self._profile = 0.0, self.encoder
            self.set("present_current", 0)
            return
        remaining = elapsed_s
        while remaining > 1e-9:
            step = min(_PUSH_S, remaining)
            remaining -= step
            top = float(abs(self.get("goal_velocity")) or FREE_SPEED)
            ahead = self.goal - self._profile
            self._profile = self._profile + max(-top * step, min(top * step, ahead)) if self.torque else self.encoder
            duty = self._duty() / 1000
            self.encoder, self.velocity = mechanics.advance(self.encoder, self.velocity, duty, step)
        ampere = mechanics.current_a(self.velocity, self._duty() / 1000) if self.torque else 0.0
        self.set("present_current", round(ampere / _AMPERE))

    def _way(self) -> float:
        return (self.goal if self.mechanics is None else self._profile) - self.encoder

    def _protect(self, elapsed_s: float) -> None:
        """Go into overload according to the table. Only torque off ends it and, a moment later, the error bit."""
        if not self.torque:
            self._heavy_s, self._overload = 0.0, False
            return
        heavy = abs(self._duty()) >= 10 * self.get("overload_torque")
        self._heavy_s = self._heavy_s + elapsed_s if heavy else 0.0
        self._overload = self._overload or (heavy and self._heavy_s >= 0.01 * self.get("protection_time"))

    def _duty(self) -> float:
        """Duty cycle of the motor [0.1 %], signed."""
        if not self.torque:
            return 0.0
        most = min(self.get("max_torque"), self.get("torque_limit"))
        if self._overload:
            most = min(most, 10 * self.get("protective_torque"))
        way = 0.0 if self.get("operating_mode") == _WHEEL else self._way()
        wanted = most if self.burdened else way * _DUTY_PER_TICK * self.get("p_coefficient") / 32
        return max(-most, min(most, wanted))

    def _make_middle(self) -> None:
        self.table[_TORQUE] = 0
        offset = round(self.encoder) - TURN // 2
        self.set("homing_offset", max(-2047, min(2047, offset)))

    def _write_byte(self, address: int, value: int) -> None:
        if address > 0xFF or _READ_ONLY[address]:
            return
        if address < _EPROM_END and self.table[_LOCK] != 0:
            return
        self.table[address] = value

    def _publish(self) -> None:
        """Update the read-only registers."""
        reported = round(self.encoder) - self.get("homing_offset")
        # With bit 4 of `phase` clear the reported position stays within one turn.
        if not self.get("phase") & 0x10:
            reported %= TURN
        self.set("present_position", reported)
        self.set("present_velocity", max(-32767, min(32767, round(self.velocity))))
        self.set("present_load", round(self._duty()))
        self.set("moving", int(abs(self.velocity) > 0))
        status = self.errors | (_OVERLOAD if self._overload else 0)
        if not self.get("min_voltage_limit") <= self.get("present_voltage") <= self.get("max_voltage_limit"):
            status |= _UNDERVOLTAGE
        if self.get("present_temperature") > self.get("max_temperature_limit"):
            status |= _OVERHEATING
        self.set("status", status)


def _read_only() -> list[bool]:
    table = [False] * 256
    entry: Register
    for entry in STS3215.values():
        for address in range(entry.address, entry.address + entry.size):
            table[address] = not entry.writable
    return table


_READ_ONLY = _read_only()
