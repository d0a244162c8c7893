"""The emulated wire: bytes of the host in, replies of the servos out, each with the time at which it is due."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ibrobot_feetech import protocol
from ibrobot_feetech.emulator.faults import Faults
from ibrobot_feetech.emulator.servo import EmulatedServo
from ibrobot_feetech.protocol import BROADCAST, Instruction, Packet
from ibrobot_feetech.registers import BAUD_RATES

_BITS = 10
"""Bits on the wire for a byte: start, eight, stop."""
_RATES = {code: rate for rate, code in BAUD_RATES.items()}


class Wire:
    """Servos on one half-duplex line.

    Args:
        servos: id -> servo, as wired; a servo answers to the id in its table.
        faults: what goes wrong.
        throttle: whether bytes take the time that they take on a wire.
        seed: of the chances.
    """

    def __init__(self, servos: Mapping[int, EmulatedServo], faults: Faults, *, throttle: bool, seed: int) -> None:
        self._servos = list(servos.values())
        self._faults = faults
        self._throttle = throttle
        self._chance = np.random.default_rng(seed)
        self._scanner = protocol.Scanner()
        self._now_s: float | None = None
        self._disconnected: set[int] = set()

    def advance(self, now_s: float) -> None:
        """Let the joints move until `now_s` [s], under the injected faults."""
        elapsed_s = now_s - self._now_s if self._now_s is not None else 0.0
        self._now_s = now_s
        faults = self._faults
        unpowered = faults.brown_out | (faults.disconnected - self._disconnected)
        self._disconnected = set(faults.disconnected)
        faults.brown_out.clear()
        for servo in self._servos:
            servo.errors = faults.errors.get(servo.id, 0)
            servo.blocked, servo.burdened = servo.id in faults.blocked, servo.id in faults.overloaded
            if servo.id in unpowered:
                servo.brown_out()
            servo.advance(max(0.0, elapsed_s))

    def receive(self, received: bytes, baud_rate: int) -> list[tuple[float, bytes]]:
        """Take bytes of the host in, sent at `baud_rate`.

        Returns:
            Seconds from now, and the bytes that go out then, in the order of sending.
        """
        replies: list[tuple[float, bytes]] = []
        for packet in self._scanner.feed(received):
            hearing = self._hearing(baud_rate)
            if not hearing:
                continue
            sent_s = self._wire_s(protocol.OVERHEAD + len(packet.parameters), baud_rate)
            for asked, content in self._carry_out(packet, hearing):
                servo = hearing[asked]
                reply = protocol.pack(Packet(asked, servo.error, content))
                if self._throttle:
                    sent_s += servo.get("return_delay") * 2e-6
                sent_s += self._wire_s(len(reply), baud_rate)
                replies += self._faults.apply(reply, sent_s, self._chance)
        return replies

    def _hearing(self, baud_rate: int) -> dict[int, EmulatedServo]:
        """Those that hear the host, by the ids in their tables."""
        silent = self._faults.silent | self._faults.disconnected
        return {
            servo.id: servo
            for servo in self._servos
            if servo.id not in silent and _RATES.get(servo.get("baud_rate")) == baud_rate
        }

    def _carry_out(self, packet: Packet, servos: dict[int, EmulatedServo]) -> list[tuple[int, bytes]]:
        """Do what a packet asks for; returns which ids answer, in order, with what.

        A servo whose id or status return level is changed answers as it would have before.
        """
        if packet.code == Instruction.SYNC_READ and len(packet.parameters) > 2:
            address, size, *ids = packet.parameters
            return [(servo, servos[servo].read(address, size)) for servo in ids if servo in servos]
        if packet.code == Instruction.SYNC_WRITE and len(packet.parameters) > 2:
            address, size = packet.parameters[:2]
            each = packet.parameters[2:]
            for begin in range(0, len(each) - size, size + 1):
                if each[begin] in servos:
                    servos[each[begin]].write(address, each[begin + 1 : begin + 1 + size])
            return []
        everyone = packet.servo == BROADCAST
        answers = []
        for servo in sorted(servos) if everyone else [packet.servo] if packet.servo in servos else []:
            asked = packet.code == Instruction.PING if everyone else _answered(servos[servo], packet)
            content = _one(servos[servo], packet)
            if content is not None and asked:
                answers.append((servo, content))
        return answers

    def _wire_s(self, size: int, baud_rate: int) -> float:
        return size * _BITS / baud_rate if self._throttle else 0.0


def _answered(servo: EmulatedServo, packet: Packet) -> bool:
    """Whether the servo's status return level has it answer; at level 0 it acknowledges no writes."""
    return servo.get("status_return_level") != 0 or packet.code in (Instruction.PING, Instruction.READ)


def _one(servo: EmulatedServo, packet: Packet) -> bytes | None:
    """Do what a packet asks of one servo; the parameters of its answer, None where there is none."""
    parameters = packet.parameters
    match packet.code:
        case Instruction.PING:
            return b""
        case Instruction.READ if len(parameters) == 2:
            return servo.read(parameters[0], parameters[1])
        case Instruction.WRITE if len(parameters) >= 2:
            servo.write(parameters[0], parameters[1:])
            return b""
        case Instruction.REG_WRITE if len(parameters) >= 2:
            servo.prepare(parameters[0], parameters[1:])
            return b""
        case Instruction.ACTION:
            servo.act()
            return b""
    return None
