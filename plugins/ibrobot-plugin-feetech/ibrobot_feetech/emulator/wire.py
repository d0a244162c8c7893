"""The emulated wire: takes the host's bytes and returns the servos' replies, with the times at which they are due."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ibrobot_feetech import protocol
from ibrobot_feetech.emulator.faults import Faults
from ibrobot_feetech.emulator.servo import EmulatedServo
from ibrobot_feetech.protocol import BROADCAST, Instruction, Packet
from ibrobot_feetech.registers import BAUD_RATES

_BITS = 10
"""Bits on the wire per byte: start, eight data bits, stop."""
_RATES = {code: rate for rate, code in BAUD_RATES.items()}


class Wire:
    """Servos on one half-duplex line.

    Args:
        servos: id -> servo, as wired; a servo answers to the id in its table.
        faults: faults to inject.
        throttle: whether to delay bytes by their time on a real wire.
        seed: seed of the faults.
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
        """Advance the joints to `now_s` [s], with the injected faults."""
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
        """Process bytes from the host, sent at `baud_rate`.

        Returns:
            Delays from now [s] and the bytes to send, in order.
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
        """The servos that receive the host's bytes, by the ids in their tables."""
        silent = self._faults.silent | self._faults.disconnected
        return {
            servo.id: servo
            for servo in self._servos
            if servo.id not in silent and _RATES.get(servo.get("baud_rate")) == baud_rate
        }

    def _carry_out(self, packet: Packet, servos: dict[int, EmulatedServo]) -> list[tuple[int, bytes]]:
        """Execute a packet; returns the answers and their ids, in order.

        A servo whose id or status return level changes still answers with the old setting.
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
    """Whether the servo answers, according to its status return level; at level 0 it does not acknowledge writes."""
    return servo.get("status_return_level") != 0 or packet.code in (Instruction.PING, Instruction.READ)


def _one(servo: EmulatedServo, packet: Packet) -> bytes | None:
    """Execute a packet on one servo; returns the parameters of its answer, or None without an answer."""
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
