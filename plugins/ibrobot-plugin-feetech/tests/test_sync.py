"""Replies that come damaged or from another servo: which are believed, and that the others are not lost with them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_feetech import protocol
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.errors import NoReply, PacketError
from ibrobot_feetech.port import SerialPort
from ibrobot_feetech.protocol import Packet
from ibrobot_feetech.sync import SyncReader

SERVOS = (1, 2, 3, 4, 5, 6)
POSITIONS = [2000 + 10 * servo for servo in SERVOS]
REPLIES = [
    protocol.pack(Packet(servo, 0, position.to_bytes(2, "little") + bytes(4)))
    for servo, position in zip(SERVOS, POSITIONS, strict=True)
]


class PreparedPort(SerialPort):
    """Answers any request with the same bytes; nothing waits."""

    def __init__(self, reply: bytes) -> None:
        super().__init__("prepared", 1_000_000)
        self._reply, self._coming = reply, b""

    def write(self, request: bytes) -> None:
        self._coming = self._reply

    def read(self, size: int, deadline: float) -> bytes:
        received, self._coming = self._coming[:size], self._coming[size:]
        return received

    def exchange(self, request: bytes, size: int, timeout_ms: int) -> bytes:
        self.write(request)
        return self.read(size, 0.0)

    def discard(self) -> int:
        return 0


def answering(reply: bytes) -> FeetechBus:
    bus = FeetechBus("prepared", retries=0)
    bus.port = PreparedPort(reply)
    return bus


def reader(bus: FeetechBus) -> SyncReader:
    return SyncReader(bus, SERVOS, "present_position", "present_load")


def test_good_replies_are_believed() -> None:
    replies = reader(answering(b"".join(REPLIES))).read()
    assert replies.complete
    assert replies.values.tolist() == [[position, 0, 0] for position in POSITIONS]


@pytest.mark.parametrize("which", [0, 3, 5])
@pytest.mark.parametrize("at", range(len(REPLIES[0])))
def test_one_damaged_byte_costs_one_reply_and_gives_no_wrong_one(which: int, at: int) -> None:
    good = REPLIES[which]
    for value in set(range(256)) - {good[at]}:
        damaged = good[:at] + bytes((value,)) + good[at + 1 :]
        bus = answering(b"".join([*REPLIES[:which], damaged, *REPLIES[which + 1 :]]))
        replies = reader(bus).read()
        # One or two more in the length, and the next header makes a good checksum: the reply behind it is lost too.
        swallows = at == 3 and value - good[at] in (1, 2) and which + 1 < len(SERVOS)
        missing = [which, which + 1] if swallows else [which]
        assert (~replies.answered).nonzero()[0].tolist() == missing
        assert all(row[0] == POSITIONS[i] for i, row in enumerate(replies.values) if i not in missing)
        assert bus.counters["bad_packets"] + bus.counters["discarded_bytes"] > 0


@given(st.permutations(REPLIES))
def test_each_reply_goes_to_the_servo_that_sent_it(replies: list[bytes]) -> None:
    assert reader(answering(b"".join(replies))).read().values[:, 0].tolist() == POSITIONS


def test_the_answer_of_another_servo_is_not_taken() -> None:
    bus = answering(protocol.pack(Packet(3, 0, b"\x10\x08")))
    with pytest.raises(NoReply, match="servo 2, present_position"):
        bus.read(2, "present_position")
    assert bus.counters["late_replies"] == 1


def test_a_damaged_answer_differs_from_none() -> None:
    good = bytearray(protocol.pack(Packet(2, 0, b"\x10\x08")))
    assert answering(bytes(good)).read(2, "present_position") == 0x0810
    good[5] ^= 1
    with pytest.raises(PacketError, match="servo 2, present_position: the reply is damaged"):
        answering(bytes(good)).read(2, "present_position")
