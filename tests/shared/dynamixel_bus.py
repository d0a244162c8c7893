"""Emulated Dynamixel servos (protocol 2.0) on a pseudo-terminal, after ROBOTIS' manuals of the protocol and XL430.

Ping, read, write, reboot, sync read and sync write, with byte stuffing, CRC and errors. A servo moves to its goal at a
constant speed; a joint without torque stays where it was turned by hand.
"""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from types import TracebackType
from typing import Self

import attrs

HEADER = b"\xff\xff\xfd"
PING, READ, WRITE, REBOOT, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x08, 0x55, 0x82, 0x83
BROADCAST = 0xFE
INSTRUCTION_ERROR, RANGE_ERROR, ACCESS_ERROR = 0x02, 0x04, 0x07
XL430, XL330_M288, XL330_M077 = 1060, 1200, 1190
"""Model numbers."""
FIELDS = {
    "model_number": (0, 2), "firmware": (6, 1), "id": (7, 1), "baud_rate": (8, 1), "return_delay": (9, 1),
    "drive_mode": (10, 1), "operating_mode": (11, 1), "homing_offset": (20, 4), "max_position": (48, 4),
    "min_position": (52, 4), "torque_enable": (64, 1), "hardware_error": (70, 1), "goal_current": (102, 2),
    "goal_position": (116, 4), "moving": (122, 1), "present_position": (132, 4), "voltage": (144, 2),
    "temperature": (146, 1),
}  # fmt: skip
"""Name -> address and size in the control table."""
EEPROM_END, POSITION_MODE, RESOLUTION = 64, 3, 4096
SPEED = 3000.0
"""Of a servo on its way to its goal [ticks/s]."""


def crc(data: bytes) -> int:
    """CRC-16 of the protocol: polynomial 0x8005, most significant bit first, from 0."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
    return value


def packet(servo: int, instruction: int, parameters: bytes) -> bytes:
    """A packet, with stuffed bytes and its CRC."""
    body = (bytes([instruction]) + parameters).replace(HEADER, HEADER + b"\xfd")
    head = HEADER + b"\x00" + bytes([servo]) + (len(body) + 2).to_bytes(2, "little")
    return head + body + crc(head + body).to_bytes(2, "little")


@attrs.define
class Servo:
    """A servo; `turned` is the encoder's angle since it was built [ticks]."""

    id: int
    model: int
    turned: float = 2048.0
    table: bytearray = attrs.field(factory=lambda: bytearray(1024))

    def __attrs_post_init__(self) -> None:
        for name, value in {
            "model_number": self.model,
            "firmware": 46,
            "id": self.id,
            "baud_rate": 3,
            "operating_mode": POSITION_MODE,
            "max_position": RESOLUTION - 1,
            "voltage": 120,
            "temperature": 30,
        }.items():
            self.set(name, value)

    def get(self, name: str) -> int:
        """A signed value of the control table."""
        if name == "present_position":
            return self.position
        address, size = FIELDS[name]
        return int.from_bytes(self.table[address : address + size], "little", signed=size == 4)

    def set(self, name: str, value: int) -> None:
        """Set a value of the control table."""
        address, size = FIELDS[name]
        self.table[address : address + size] = value.to_bytes(size, "little", signed=value < 0)

    @property
    def reverses(self) -> bool:
        """Whether positions decrease as the encoder's angle increases."""
        return bool(self.get("drive_mode") & 1)

    @property
    def position(self) -> int:
        """The reported position [ticks]: within a turn in position mode."""
        turned = round(-self.turned if self.reverses else self.turned)
        return (turned % RESOLUTION if self.get("operating_mode") == POSITION_MODE else turned) + self.get(
            "homing_offset"
        )

    def turn_to(self, position: float) -> None:
        """Turn the joint by hand to a reported position [ticks]."""
        self.turned += (position - self.position) * (-1 if self.reverses else 1)

    def advance(self, step_s: float) -> None:
        """Move towards the goal."""
        if self.get("torque_enable"):
            away = self.get("goal_position") - self.position
            step = max(-SPEED * step_s, min(SPEED * step_s, away))
            self.turned += -step if self.reverses else step

    def read(self, address: int, size: int) -> bytes:
        """A part of the control table."""
        self.set("moving", int(self.get("goal_position") != self.position and self.get("torque_enable")))
        first = FIELDS["present_position"][0]
        self.table[first : first + 4] = self.position.to_bytes(4, "little", signed=True)
        return bytes(self.table[address : address + size])

    def write(self, address: int, data: bytes) -> int:
        """Write a part of the control table; returns the error code."""
        if address < EEPROM_END and self.get("torque_enable"):
            return ACCESS_ERROR
        goal, size = FIELDS["goal_position"]
        if address == goal and self.get("operating_mode") == POSITION_MODE:
            wanted = int.from_bytes(data[:size], "little", signed=True)
            if not self.get("min_position") <= wanted <= self.get("max_position"):
                return RANGE_ERROR
        torque = FIELDS["torque_enable"][0]
        if address == torque and data[0] and not self.table[torque]:
            self.set("goal_position", self.position)  # torque comes back where the joint is
        self.table[address : address + len(data)] = data
        return 0


class DynamixelBus:
    """Servos behind a pseudo-terminal; a context manager. Hold `lock` to look at them.

    Args:
        servos: the servos.

    Attributes:
        silent: ids of servos that do not answer.
    """

    def __init__(self, servos: list[Servo]) -> None:
        self.servos = {servo.id: servo for servo in servos}
        self.silent: set[int] = set()
        self.lock = threading.RLock()
        self._received = bytearray()

    def __enter__(self) -> Self:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._stop, self._stopper = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="dynamixel bus", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        os.write(self._stopper, b"x")
        self._thread.join()
        for descriptor in (self._master, self._slave, self._stop, self._stopper):
            os.close(descriptor)

    def _serve(self) -> None:
        last_s = time.monotonic()
        while True:
            ready, _, _ = select.select([self._master, self._stop], [], [])
            if self._stop in ready:
                return
            self._received += os.read(self._master, 4096)
            with self.lock:
                now_s = time.monotonic()
                for servo in self.servos.values():
                    servo.advance(now_s - last_s)
                last_s = now_s
                replies = b"".join(self._replies())
            os.write(self._master, replies)

    def _replies(self) -> list[bytes]:
        """The replies to all packets that have arrived completely."""
        replies: list[bytes] = []
        while (begin := self._received.find(HEADER + b"\x00")) >= 0:
            del self._received[:begin]
            if len(self._received) < 7:
                break
            size = 7 + int.from_bytes(self._received[5:7], "little")
            if len(self._received) < size:
                break
            whole = bytes(self._received[:size])
            del self._received[:size]
            if crc(whole[:-2]) == int.from_bytes(whole[-2:], "little"):
                body = whole[7:-2].replace(HEADER + b"\xfd", HEADER)
                replies += self._carry_out(whole[4], body[0], body[1:])
        return replies

    def _carry_out(self, servo: int, instruction: int, parameters: bytes) -> list[bytes]:
        if instruction == SYNC_READ:
            address, size = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
            return [
                self._status(each, 0, self.servos[each].read(address, size)) for each in self._known(parameters[4:])
            ]
        if instruction == SYNC_WRITE:
            address, size = (int.from_bytes(parameters[i : i + 2], "little") for i in (0, 2))
            for i in range(4, len(parameters), size + 1):
                if parameters[i] in self.servos:
                    self.servos[parameters[i]].write(address, parameters[i + 1 : i + 1 + size])
            return []
        asked = list(self.servos) if servo == BROADCAST else [servo]
        return [self._answer(each, instruction, parameters) for each in self._known(bytes(asked))]

    def _answer(self, number: int, instruction: int, parameters: bytes) -> bytes:
        servo = self.servos[number]
        address = int.from_bytes(parameters[:2], "little")
        if instruction == PING:
            return self._status(number, 0, servo.read(0, 2) + servo.read(6, 1))
        if instruction == READ:
            return self._status(number, 0, servo.read(address, int.from_bytes(parameters[2:4], "little")))
        if instruction == WRITE:
            return self._status(number, servo.write(address, parameters[2:]))
        if instruction == REBOOT:
            servo.set("torque_enable", 0)
            return self._status(number, 0)
        return self._status(number, INSTRUCTION_ERROR)

    def _known(self, asked: bytes) -> list[int]:
        return [each for each in asked if each in self.servos and each not in self.silent]

    @staticmethod
    def _status(servo: int, error: int, parameters: bytes = b"") -> bytes:
        return packet(servo, STATUS, bytes([error]) + parameters)
