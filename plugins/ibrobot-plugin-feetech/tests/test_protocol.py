"""Packets: known bytes, round trips, and streams with garbage in them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_feetech import protocol
from ibrobot_feetech.errors import FeetechError, Place, ServoFault
from ibrobot_feetech.protocol import Packet, Scanner, pack

packets = st.builds(Packet, st.integers(0, 0xFE), st.integers(0, 0xFF), st.binary(max_size=protocol.MAX_PARAMETERS))


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (protocol.ping(1), "ff ff 01 02 01 fb"),
        (protocol.read(1, 56, 2), "ff ff 01 04 02 38 02 be"),
        (protocol.write(1, 5, b"\x01"), "ff ff 01 04 03 05 01 f1"),
        (protocol.sync_read((1, 2), 56, 8), "ff ff fe 06 82 38 08 01 02 36"),
        (protocol.sync_write(42, {1: b"\x00\x08", 2: b"\x01\x08"}), "ff ff fe 0a 83 2a 02 01 00 08 02 01 08 34"),
    ],
)
def test_known_bytes(made: bytes, expected: str) -> None:
    assert made.hex(" ") == expected


@given(packets)
def test_scanning_undoes_packing(packet: Packet) -> None:
    assert Scanner().feed(pack(packet)) == [packet]


@given(packets, st.data())
def test_a_packet_with_one_changed_byte_is_none(packet: Packet, data: st.DataObject) -> None:
    raw = bytearray(pack(packet))
    at, change = data.draw(st.integers(0, len(raw) - 1)), data.draw(st.integers(1, 0xFF))
    raw[at] ^= change
    # What its parameters hold may look like a packet, but not like this one.
    assert all(len(found.parameters) < len(packet.parameters) for found in Scanner().feed(bytes(raw)))


@given(st.binary(max_size=40))
def test_every_byte_is_of_a_packet_or_discarded(raw: bytes) -> None:
    scanner = Scanner()
    found = scanner.feed(raw)
    found += scanner.finish()
    assert sum(len(pack(packet)) for packet in found) + scanner.discarded == len(raw)
    assert all(pack(packet) in raw for packet in found)


@given(st.lists(packets, max_size=4), st.integers(1, 9))
def test_scanner_finds_packets_in_any_slices(sent: list[Packet], step: int) -> None:
    sent = [packet for packet in sent if len(packet.parameters) < 30]
    stream = b"".join(map(pack, sent))
    scanner = Scanner()
    found = [packet for i in range(0, len(stream), step) for packet in scanner.feed(stream[i : i + step])]
    assert found == sent
    assert scanner.discarded == 0


@given(st.lists(st.binary(max_size=30), max_size=8), packets)
def test_scanner_finds_its_way_after_garbage(garbage: list[bytes], packet: Packet) -> None:
    scanner = Scanner()
    for part in garbage:
        scanner.feed(part)
    scanner.finish()
    assert scanner.feed(pack(packet)) == [packet]


def test_a_damaged_length_does_not_hide_what_follows() -> None:
    good, bad = Packet(2, 0, b"\x10\x08"), bytearray(pack(Packet(1, 0, b"\x10\x08")))
    bad[3] = 0xF0
    scanner = Scanner()
    assert scanner.feed(bytes(bad) + pack(good)) == []
    assert scanner.finish() == [good]
    assert scanner.discarded == len(bad)


def test_scanner_skips_a_corrupt_packet_and_an_extra_ff() -> None:
    good, bad = Packet(2, 0, b"\x10\x08"), bytearray(pack(Packet(1, 0, b"\x10\x08")))
    bad[5] ^= 1
    scanner = Scanner()
    assert scanner.feed(bytes(bad) + b"\xff" + pack(good)) == [good]
    assert scanner.discarded == len(bad) + 1


def test_error_bits_are_named() -> None:
    assert protocol.faults(0b100100) == ("overheating", "overload")
    assert protocol.faults(0x80) == ("unknown error bit 7",)


@pytest.mark.parametrize("kind", [FeetechError, *FeetechError.__subclasses__()])
def test_errors_say_where_and_what_to_check(kind: type[FeetechError]) -> None:
    what = ("overload",) if kind is ServoFault else "something happened"
    message = str(kind(Place("/dev/ttyACM0", 3, "elbow_flex", "present_position"), what))  # type: ignore[arg-type]
    assert message.startswith("/dev/ttyACM0, servo 3 (elbow_flex), present_position: ")
    assert message.endswith(f"; {kind.check}")


@pytest.mark.parametrize("servo", [-1, 255])
def test_ids_that_no_servo_has(servo: int) -> None:
    with pytest.raises(ValueError, match=f"not {servo}"):
        protocol.ping(servo)


def test_sync_needs_distinct_servos_and_one_length() -> None:
    with pytest.raises(ValueError, match="distinct"):
        protocol.sync_read((1, 1), 56, 2)
    with pytest.raises(ValueError, match="distinct"):
        protocol.sync_read((), 56, 2)
    with pytest.raises(ValueError, match="same number of bytes"):
        protocol.sync_write(42, {1: b"\x00", 2: b"\x00\x00"})
