"""A Feetech bus: matches replies to requests, checks them, retries requests, and counts errors.

The protocol has no sequence numbers: a reply contains its servo and length, but not its request. A reply that arrives
after its request timed out could therefore be mistaken for the answer to the next one, and every later answer would be
one request old. So after a timeout, the servo and the length of the expected reply are kept on a list, for longer
than any reply can be late. (A reply that arrived damaged, with exactly the expected number of bytes, is not listed,
because it cannot arrive again.) Meanwhile

- a read requests a span of another length, by beginning some registers earlier;
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
"""Upper bound on the delay of a reply [s]; adapters have delayed replies by 0.08 s."""
_ADAPTER_S = 0.004
"""Time for the USB adapter and the kernel, in addition to the time on the wire [s]."""
_TRAIL_S = 0.001
"""How long to keep listening when the expected number of bytes has arrived, but some are damaged [s]."""
RETURN_DELAY_S = 0.000_5
"""Default delay of a servo before it answers [s]: 250 units of 2 us."""
_EPROM_S = 0.02
"""Additional time for the acknowledgement of an EPROM write [s]."""
_MOST_EXTRA = 16
"""Maximum number of extra bytes to read so that a reply has a unique length."""
_BITS_PER_BYTE = 10


class FeetechBus:
    """One half-duplex bus on one serial port; used by one thread at a time.

    Args:
        port: e.g. `/dev/ttyACM0`.
        baud_rate: [baud].
        joints: servo id -> joint, for the messages of errors.
        retries: how often to repeat a failed request before raising an error.
        patience_s: how much longer than usual to wait for replies, where nothing is waiting for them [s].
    """

    def __init__(
        self, port: str, *, baud_rate: int = 1_000_000, joints: Mapping[int, str] | None = None, retries: int = 2,
        patience_s: float = 0.0,
    ) -> None:  # fmt: skip
        self.port = SerialPort(port, baud_rate)
        self.joints = dict(joints or {})
        self.retries = retries
        self.patience_s = patience_s
        self.return_delay_s = RETURN_DELAY_S
        """Delay of every servo before it answers [s]; shorter once the servos are configured."""
        self.counters: Counter[str] = Counter(
            dict.fromkeys(("requests", "retries", "timeouts", "late_replies", "bad_packets", "discarded_bytes"), 0)
        )
        """Counts of requests and errors since the bus was created."""
        self.outstanding: dict[tuple[int, int], float] = {}
        """Servo and length of replies that may still arrive late -> until when (`time.monotonic`) [s]."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self.port.is_open

    def open(self) -> None:
        """Open the port.

        Raises:
            PortError: if it does not exist, is not permitted, or is held by another program.
        """
        self.outstanding.clear()
        self.port.open()

    def close(self) -> None:
        """Close the port. Safe to call twice."""
        self.port.close()

    def place(self, servo: int | None = None, name: str | None = None) -> Place:
        """A place on this bus, for error messages."""
        return Place(self.port.path, servo, self.joints.get(servo) if servo is not None else None, name)

    def ping(self, servo: int) -> int:
        """Check that a servo answers; returns its model number.

        Raises:
            NoReply: if it does not answer.
        """
        return self.read(servo, "model_number")

    def scan(self, servos: Iterable[int] = range(protocol.MAX_ID + 1), *, one_by_one: bool = True) -> dict[int, int]:
        """Find servos; returns servo id -> model number.

        Args:
            servos: ids to look for.
            one_by_one: whether to ping each id, which takes seconds, if no servo answers a broadcast ping.

        Raises:
            PortError: if the port is gone.
        """
        wanted = set(servos)
        self.begin_request()
        self.port.write(protocol.ping(BROADCAST))
        # Servos answer in turn, in the order of their ids.
        timeout_s = self.timeout(OVERHEAD, OVERHEAD * len(wanted)) + 0.001 * len(wanted)
        answering = {
            p.servo for p in self._collect(OVERHEAD * (protocol.MAX_ID + 1), timeout_s, bytearray()) if not p.parameters
        }
        for servo in wanted:
            self._expect_late(servo, 0)
        model = STS3215["model_number"]
        if answering & wanted:
            return {servo: self.read_faulty(servo, model.name) for servo in sorted(answering & wanted)}
        models = {}
        for servo in sorted(wanted) if one_by_one else ():
            with suppress(NoReply, PacketError):
                models[servo] = self._read_once(servo, model, faulty=True)
        return models

    def read(self, servo: int, name: str) -> int:
        """Read a register.

        Raises:
            FeetechError: if no valid reply arrived after all retries.
        """
        return self._retried(lambda: self._read_once(servo, register(name)))

    def read_faulty(self, servo: int, name: str) -> int:
        """As `read`, but also accepts replies of a servo that reports an error."""
        return self._retried(lambda: self._read_once(servo, register(name), faulty=True))

    def firmware(self, servo: int) -> str:
        """The firmware version of a servo, also of one that reports an error.

        Raises:
            FeetechError: if no valid reply arrived after all retries.
        """
        return ".".join(str(self.read_faulty(servo, f"firmware_{part}")) for part in ("major", "minor"))

    def write(self, servo: int, name: str, value: int, *, faulty: bool = False) -> None:
        """Set a register and wait for the acknowledgement.

        Args:
            servo: servo id.
            name: register name.
            value: new value.
            faulty: whether to accept replies of a servo that reports an error, e.g. while its torque is switched off.

        Raises:
            FeetechError: if no acknowledgement arrived after all retries, or for an EPROM register while it is locked.
            ValueError: if the value is out of range or the register is read-only.
        """
        target = writable(name)
        request = protocol.write(servo, target.address, target.encode(value))
        # A servo acknowledges this nevertheless, but loses the value with its power.
        if target.area == "eprom" and self.read_faulty(servo, "lock"):
            raise EpromLocked(self.place(servo, name), f"EPROM is locked, {value} was not written")
        self._retried(lambda: self._write_once(servo, target, value, request, faulty=faulty))

    def sync_read(self, name: str, servos: Sequence[int], *, faulty: bool = False) -> dict[int, int]:
        """Read a register of several servos in one request; `faulty` also accepts servos that report errors.

        Returns:
            Servo id -> value.

        Raises:
            FeetechError: if a servo sent no valid reply after all retries.
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
        """Set a register of several servos in one request; no servo answers.

        Raises:
            PortError: if the port is gone.
            ValueError: if a value is out of range or the register is read-only.
        """
        target = writable(name)
        self.counters["requests"] += 1
        self.port.write(protocol.sync_write(target.address, {s: target.encode(v) for s, v in values.items()}))

    def sync_read_span(self, address: int, size: int, servos: Sequence[int]) -> dict[int, tuple[bytes, int]]:
        """Read `size` bytes from `address` of several servos in one request.

        Nothing is sent while too many replies may be late, because no reply on such a line can be trusted.

        Returns:
            Servo id -> bytes and error byte, for the servos that answered.

        Raises:
            PortError: if the port is gone.
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
        """Collect the replies to a sync read whose first bytes are `received`, and list the missing ones."""
        wanted = set(servos)
        replies: dict[int, tuple[bytes, int]] = {}
        expected = (OVERHEAD + length) * len(servos)
        heard, foreign = bytearray(), self.counters["late_replies"]
        for packet in self._collect(expected, self.timeout(len(request), expected, len(servos)), heard, received):
            if packet.servo not in wanted or not self._is_answer(packet, length) or packet.servo in replies:
                self.counters["late_replies"] += 1
                continue
            replies[packet.servo] = packet.parameters[skip : skip + size], packet.code
            if len(replies) == len(wanted):
                break
        own = self.counters["late_replies"] == foreign
        if not (own and _all_in_place(heard, servos, replies, OVERHEAD + length)):
            for servo in wanted - replies.keys():
                self._lost(servo, length)
        return replies

    def resynchronise(self) -> None:
        """Wait for `LATE_S`, after which no late reply can arrive; for use after a fault.

        Raises:
            PortError: if the port is gone.
        """
        end = time.monotonic() + LATE_S
        while time.monotonic() < end:
            self.counters["discarded_bytes"] += len(self.port.read(255, end))
        self.outstanding.clear()

    def may_be_late(self, servo: int, length: int) -> bool:
        """Whether a reply of that length may still arrive for an earlier request that timed out."""
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
                pass  # it may have been set nevertheless: read the register
            else:
                return
        else:
            # Its acknowledgement, for which nothing waits, may be late too.
            self._expect_late(servo, 0)
            self.counters["requests"] += 1
            self.port.write(request)
        stored = self._read_once(servo, target, faulty=True)
        if stored != value:
            raise UnexpectedReply(self.place(servo, target.name), f"it was set to {value} and reads {stored}")

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
            raise PacketError(self.place(servo, name), "the reply is damaged")
        self._lost(servo, length)
        raise NoReply(self.place(servo, name), f"no reply within {timeout_s * 1e3:.1f} ms")

    def _is_answer(self, packet: Packet, length: int) -> bool:
        return len(packet.parameters) == length and not self.may_be_late(packet.servo, length)

    def _collect(self, expected: int, timeout_s: float, heard: bytearray, received: bytes = b"") -> Generator[Packet]:
        """Yield packets as they arrive, until the timeout; the caller stops when it has the expected ones.

        All received bytes are appended to `heard`.
        """
        missing = expected - len(received)
        last = time.monotonic() + timeout_s
        deadline = last if missing > 0 else min(last, time.monotonic() + _TRAIL_S)
        scanner = protocol.Scanner()
        try:
            while True:
                heard += received
                yield from scanner.feed(received)
                # Some bytes may be garbage: continue until the timeout, one packet at a time.
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
        """Start address and number of bytes of a read such that no late reply has the same length.

        Returns (0, 0) if too many replies may be late.
        """
        for extra in range(min(address, _MOST_EXTRA) + 1):
            if not any(self.may_be_late(servo, size + extra) for servo in servos):
                return address - extra, size + extra
        return 0, 0

    def begin_request(self) -> None:
        """Count a request, and discard bytes received before it.

        Raises:
            PortError: if the port is gone.
        """
        self.counters["requests"] += 1
        self.counters["discarded_bytes"] += self.port.discard()

    def _lost(self, servo: int, length: int) -> None:
        self.counters["timeouts"] += 1
        self._expect_late(servo, length)

    def _expect_late(self, servo: int, length: int) -> None:
        self.outstanding[servo, length] = time.monotonic() + LATE_S

    def timeout(self, sent: int, expected: int, servos: int = 1) -> float:
        """How long to wait for replies [s]: wire time of request and replies, plus the delays on both sides."""
        wire_s = (sent + expected) * _BITS_PER_BYTE / self.port.baud_rate
        return wire_s + servos * self.return_delay_s + _ADAPTER_S + self.patience_s

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
        return f"no reply; nor from any other of servos {names}"


def _all_in_place(heard: bytearray, servos: Sequence[int], replies: Container[int], size: int) -> bool:
    """Whether exactly the expected replies arrived, each with `size` bytes and in order, valid or damaged."""
    if len(heard) != size * len(servos):
        return False
    places = enumerate(servos)
    return all(heard[i * size + 2] == servo for i, servo in places if servo in replies)
