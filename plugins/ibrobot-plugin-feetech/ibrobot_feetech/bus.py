"""A Feetech bus: requests and their replies, each matched, checked, retried and counted.

The protocol has no sequence numbers: a reply says which servo sent it and how long it is, nothing more. A reply that
comes after its request timed out could therefore be taken for the answer to the next one, and every later answer would
then be one request old. So an exchange that timed out leaves its servo and the length of its reply on a list, for
longer than any reply can be late (but not where exactly the bytes came that were due: a reply that came damaged comes
no more); meanwhile

- a read asks for a span of another length, by beginning some registers earlier;
- a reply of a listed length is dropped and counted;
- a write, whose acknowledgements are all alike, is confirmed by reading the register back.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Container, Generator, Iterable, Mapping, Sequence
from contextlib import suppress

from ibrobot_feetech import protocol
from ibrobot_feetech.errors import EpromLocked, NoReply, PacketError, Place, ServoFault, UnexpectedReply
from ibrobot_feetech.port import SerialPort
from ibrobot_feetech.protocol import BROADCAST, OVERHEAD, Packet
from ibrobot_feetech.registers import STS3215, Register, register, writable

LATE_S = 0.5
"""Longer than a reply can be late [s]: adapters held one back for 0.08 s."""
_ADAPTER_S = 0.004
"""Time for the USB adapter and the kernel beside the time on the wire [s]."""
_TRAIL_S = 0.001
"""How long to go on listening when as many bytes came as were asked for, but not all of them good [s]."""
RETURN_DELAY_S = 0.000_5
"""A servo's own delay before it answers, as it is shipped [s]: 250 units of 2 us."""
_EPROM_S = 0.02
"""Further time for an acknowledgement, where the servo first writes its EPROM [s]."""
_MOST_EXTRA = 16
"""Most bytes that are read for nothing so that a reply has a length of its own."""
_BITS_PER_BYTE = 10


class FeetechBus:
    """One half-duplex bus on one serial port; used by one thread at a time.

    Args:
        port: e.g. `/dev/ttyACM0`.
        baud_rate: [baud].
        joints: servo id -> joint, for the messages of errors.
        retries: how often a request that failed is sent again before it is an error.
    """

    def __init__(
        self, port: str, *, baud_rate: int = 1_000_000, joints: Mapping[int, str] | None = None, retries: int = 2
    ) -> None:
        self.port = SerialPort(port, baud_rate)
        self.joints = dict(joints or {})
        self.retries = retries
        self.return_delay_s = RETURN_DELAY_S
        """What every servo waits before it answers [s]; less once they are set up."""
        self.counters: Counter[str] = Counter(
            dict.fromkeys(("requests", "retries", "timeouts", "late_replies", "bad_packets", "discarded_bytes"), 0)
        )
        """Every request and everything that went wrong, since the bus was made."""
        self.outstanding: dict[tuple[int, int], float] = {}
        """Servo and length of replies that may yet come late -> until when (`time.monotonic`) [s]."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self.port.is_open

    def open(self) -> None:
        """Open the port.

        Raises:
            PortError: when it is not there, not permitted, or held by another program.
        """
        self.outstanding.clear()
        self.port.open()

    def close(self) -> None:
        """Close the port. Safe to call twice."""
        self.port.close()

    def place(self, servo: int | None = None, name: str | None = None) -> Place:
        """Where on this bus something happens, for an error's message."""
        return Place(self.port.path, servo, self.joints.get(servo) if servo is not None else None, name)

    def ping(self, servo: int) -> int:
        """The model number of a servo, which is there if this returns.

        Raises:
            NoReply: when it is not.
        """
        return self.read(servo, "model_number")

    def scan(self, servos: Iterable[int] = range(protocol.MAX_ID + 1), *, one_by_one: bool = True) -> dict[int, int]:
        """Servo id -> model number, of those that answer a broadcast ping or, where none does, one of their own.

        Args:
            servos: ids to look for.
            one_by_one: whether to ask each id, which takes seconds, where none answers the broadcast.

        Raises:
            PortError: when the port is gone.
        """
        wanted = set(servos)
        self.begin_request()
        self.port.write(protocol.ping(BROADCAST))
        # Each servo waits for its turn, which is due by its id.
        timeout_s = self.timeout(OVERHEAD, OVERHEAD * len(wanted)) + 0.001 * len(wanted)
        found = {
            p.servo for p in self._collect(OVERHEAD * (protocol.MAX_ID + 1), timeout_s, bytearray()) if not p.parameters
        }
        for servo in wanted:
            self._expect_late(servo, 0)
        model = STS3215["model_number"]
        if found & wanted:
            return {servo: self.read_faulty(servo, model.name) for servo in sorted(found & wanted)}
        models = {}
        for servo in sorted(wanted) if one_by_one else ():
            with suppress(NoReply, PacketError):
                models[servo] = self._read_once(servo, model, faulty=True)
        return models

    def read(self, servo: int, name: str) -> int:
        """The value of a register.

        Raises:
            FeetechError: when no good reply came, after all retries.
        """
        return self._retried(lambda: self._read_once(servo, register(name)))

    def read_faulty(self, servo: int, name: str) -> int:
        """As `read`, also from a servo that reports an error of its own."""
        return self._retried(lambda: self._read_once(servo, register(name), faulty=True))

    def write(self, servo: int, name: str, value: int, *, faulty: bool = False) -> None:
        """Set a register and wait for the servo to say that it is set.

        Args:
            servo: its id.
            name: of the register.
            value: what it is set to.
            faulty: whether a servo may report an error of its own meanwhile, e.g. while its torque is taken off.

        Raises:
            FeetechError: when it did not, after all retries, or for a register of EPROM while that is locked.
            ValueError: for a value that the register cannot hold, or a register that cannot be set.
        """
        target = writable(name)
        request = protocol.write(servo, target.address, target.encode(value))
        # A servo acknowledges this all the same, and forgets the value without power.
        if target.area == "eprom" and self.read_faulty(servo, "lock"):
            raise EpromLocked(self.place(servo, name), f"EPROM is locked, {value} was not written")
        self._retried(lambda: self._write_once(servo, target, value, request, faulty=faulty))

    def reg_write(self, servo: int, name: str, value: int) -> None:
        """Prepare a register's value, which `action` sets.

        Raises:
            FeetechError: when the servo did not acknowledge it. It is sent once: there is no telling by reading back.
        """
        target = writable(name)
        request = protocol.reg_write(servo, target.address, target.encode(value))
        self._acknowledged(servo, target, request, faulty=False)

    def action(self) -> None:
        """Set on all servos at once what `reg_write` prepared; none answers."""
        self.counters["requests"] += 1
        self.port.write(protocol.action())

    def sync_read(self, name: str, servos: Sequence[int], *, faulty: bool = False) -> dict[int, int]:
        """Servo id -> value of a register, asked for in one request; with `faulty` also of servos that report errors.

        Raises:
            FeetechError: when a servo did not answer well, after all retries.
        """
        target = register(name)
        missing, values = list(servos), dict[int, int]()
        for attempt in range(self.retries + 1):
            self.counters["retries"] += attempt > 0
            if not self._span(missing, target.address, target.size)[1]:
                self.resynchronise()
            for servo, (content, code) in self.sync_read_span(target.address, target.size, missing).items():
                if code and not faulty:
                    raise ServoFault(self.place(servo, name), protocol.faults(code))
                values[servo] = target.decode(content)
            missing = [servo for servo in servos if servo not in values]
            if not missing:
                return {servo: values[servo] for servo in servos}
        raise NoReply(self.place(missing[0], name), self._silence(missing))

    def sync_write(self, name: str, values: Mapping[int, int]) -> None:
        """Set a register of several servos in one request; none answers.

        Raises:
            PortError: when the port is gone.
            ValueError: for a value that the register cannot hold, or a register that cannot be set.
        """
        target = writable(name)
        self.counters["requests"] += 1
        self.port.write(protocol.sync_write(target.address, {s: target.encode(v) for s, v in values.items()}))

    def sync_read_span(self, address: int, size: int, servos: Sequence[int]) -> dict[int, tuple[bytes, int]]:
        """Servo id -> registers from `address`, shape (size,), and error byte; of those that answered in one request.

        None is asked while too many replies may be late: on a line as bad as that nothing can be believed.

        Raises:
            PortError: when the port is gone.
        """
        start, length = self._span(servos, address, size)
        if not length:
            return {}
        self.begin_request()
        request = protocol.sync_read(servos, start, length)
        self.port.write(request)
        return self.sync_replies(b"", request, servos, length, address - start, size)

    def sync_replies(
        self, received: bytes, request: bytes, servos: Sequence[int], length: int, skip: int, size: int
    ) -> dict[int, tuple[bytes, int]]:
        """Take in the replies to a sync read whose first bytes are `received`, and list those that did not come."""
        wanted = set(servos)
        found: dict[int, tuple[bytes, int]] = {}
        expected = (OVERHEAD + length) * len(servos)
        heard, foreign = bytearray(), self.counters["late_replies"]
        for packet in self._collect(expected, self.timeout(len(request), expected, len(servos)), heard, received):
            if packet.servo not in wanted or not self._is_answer(packet, length) or packet.servo in found:
                self.counters["late_replies"] += 1
                continue
            found[packet.servo] = packet.parameters[skip : skip + size], packet.code
            if len(found) == len(wanted):
                break
        own = self.counters["late_replies"] == foreign
        if not (own and _all_in_place(heard, servos, found, OVERHEAD + length)):
            for servo in wanted - found.keys():
                self._lost(servo, length)
        return found

    def resynchronise(self) -> None:
        """Wait until no reply can be late any more; for after a fault, since it takes `LATE_S`.

        Raises:
            PortError: when the port is gone.
        """
        end = time.monotonic() + LATE_S
        while time.monotonic() < end:
            self.counters["discarded_bytes"] += len(self.port.read(255, end))
        self.outstanding.clear()

    def may_be_late(self, servo: int, length: int) -> bool:
        """Whether a reply of that length may still come from an earlier request that timed out."""
        expiry = self.outstanding.get((servo, length))
        if expiry is None:
            return False
        if time.monotonic() < expiry:
            return True
        del self.outstanding[servo, length]
        return False

    def _read_once(self, servo: int, target: Register, *, faulty: bool = False) -> int:
        start, length = self._span((servo,), target.address, target.size)
        if not length:
            self.resynchronise()
            start, length = target.address, target.size
        packet = self._exchange(servo, length, protocol.read(servo, start, length), target.name)
        if packet.code and not faulty:
            raise ServoFault(self.place(servo, target.name), protocol.faults(packet.code))
        skip = target.address - start
        return target.decode(packet.parameters[skip : skip + target.size])

    def _write_once(self, servo: int, target: Register, value: int, request: bytes, *, faulty: bool) -> None:
        if not self.may_be_late(servo, 0):
            try:
                self._acknowledged(servo, target, request, faulty=faulty)
            except NoReply:
                pass  # it may have been set all the same: the register tells
            else:
                return
        else:
            # Its acknowledgement, which nobody waits for, may be late in its turn.
            self._expect_late(servo, 0)
            self.counters["requests"] += 1
            self.port.write(request)
        found = self._read_once(servo, target, faulty=True)
        if found != value:
            raise UnexpectedReply(self.place(servo, target.name), f"it was set to {value} and reads {found}")

    def _acknowledged(self, servo: int, target: Register, request: bytes, *, faulty: bool) -> None:
        extra_s = _EPROM_S if target.area == "eprom" else 0.0
        packet = self._exchange(servo, 0, request, target.name, extra_s)
        if packet.code and not faulty:
            raise ServoFault(self.place(servo, target.name), protocol.faults(packet.code))

    def _exchange(self, servo: int, length: int, request: bytes, name: str, extra_s: float = 0.0) -> Packet:
        """Send a request to one servo and wait for its reply with `length` parameters."""
        self.begin_request()
        self.port.write(request)
        timeout_s = self.timeout(len(request), OVERHEAD + length) + extra_s
        heard, foreign = bytearray(), self.counters["late_replies"]
        for packet in self._collect(OVERHEAD + length, timeout_s, heard):
            if packet.servo == servo and self._is_answer(packet, length):
                return packet
            self.counters["late_replies"] += 1
        own = self.counters["late_replies"] == foreign
        if own and _all_in_place(heard, (servo,), {}, OVERHEAD + length):
            raise PacketError(self.place(servo, name), "the reply came damaged")
        self._lost(servo, length)
        raise NoReply(self.place(servo, name), f"no reply within {timeout_s * 1e3:.1f} ms")

    def _is_answer(self, packet: Packet, length: int) -> bool:
        return len(packet.parameters) == length and not self.may_be_late(packet.servo, length)

    def _collect(self, expected: int, timeout_s: float, heard: bytearray, received: bytes = b"") -> Generator[Packet]:
        """Packets as they come, until the time is over; the caller stops when it has what it waits for.

        All bytes are added to `heard`.
        """
        missing = expected - len(received)
        last = time.monotonic() + timeout_s
        deadline = last if missing > 0 else min(last, time.monotonic() + _TRAIL_S)
        scanner = protocol.Scanner()
        try:
            while True:
                heard += received
                yield from scanner.feed(received)
                # What came may have been garbage: go on while there is time, a packet at a time.
                received = self.port.read(max(missing, OVERHEAD), deadline)
                if not received:
                    yield from scanner.finish()
                    return
                missing -= len(received)
                if missing <= 0:
                    deadline = min(last, time.monotonic() + _TRAIL_S)
        finally:
            self.counters["bad_packets"] += scanner.damaged
            self.counters["discarded_bytes"] += scanner.discarded

    def _span(self, servos: Sequence[int], address: int, size: int) -> tuple[int, int]:
        """Where to begin reading, and how many bytes, so that no reply that may be late has that length.

        Nothing (0, 0) where too many may be late.
        """
        for extra in range(min(address, _MOST_EXTRA) + 1):
            if not any(self.may_be_late(servo, size + extra) for servo in servos):
                return address - extra, size + extra
        return 0, 0

    def begin_request(self) -> None:
        """Count a request, and throw away what came unasked before it.

        Raises:
            PortError: when the port is gone.
        """
        self.counters["requests"] += 1
        self.counters["discarded_bytes"] += self.port.discard()

    def _lost(self, servo: int, length: int) -> None:
        self.counters["timeouts"] += 1
        self._expect_late(servo, length)

    def _expect_late(self, servo: int, length: int) -> None:
        self.outstanding[servo, length] = time.monotonic() + LATE_S

    def timeout(self, sent: int, expected: int, servos: int = 1) -> float:
        """How long to wait for replies [s]: the time on the wire of both, and the delays on both sides."""
        wire_s = (sent + expected) * _BITS_PER_BYTE / self.port.baud_rate
        return wire_s + servos * self.return_delay_s + _ADAPTER_S

    def _retried[T](self, act: Callable[[], T]) -> T:
        for attempt in range(self.retries + 1):
            self.counters["retries"] += attempt > 0
            try:
                return act()
            except (NoReply, PacketError) as error:
                last = error
        raise last

    def _silence(self, missing: Sequence[int]) -> str:
        if len(missing) == 1:
            return "no reply"
        names = ", ".join(
            f"{servo} ({self.joints[servo]})" if servo in self.joints else str(servo) for servo in missing
        )
        return f"no reply; nor from the others of servos {names}"


def _all_in_place(heard: bytearray, servos: Sequence[int], found: Container[int], size: int) -> bool:
    """Whether exactly the replies came that were due, each of `size` bytes and in its place, good or damaged."""
    if len(heard) != size * len(servos):
        return False
    places = enumerate(servos)
    return all(heard[i * size + 2] == servo for i, servo in places if servo in found)
