"""Streams of messages, whole, cut, damaged and mixed with garbage."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from ibrobot_imu.messages import READERS, Angles

from .sensor import MESSAGES, bno08x, witmotion

MODELS = sorted(READERS)
RESOLUTION = {"bno08x": 0.01, "witmotion": 180 / 32768}
angles = st.tuples(st.floats(-179.9, 179.9), st.floats(-90, 90), st.floats(-179.9, 179.9))


def cut(stream: bytes, sizes: list[int]) -> list[bytes]:
    pieces, at = [], 0
    for size in sizes:
        pieces.append(stream[at : at + size])
        at += size
    return [*pieces, stream[at:]]


def near(found: Angles, degrees: tuple[float, float, float], model: str) -> bool:
    pairs = zip((found.yaw, found.pitch, found.roll), degrees, strict=True)
    return all(abs(math.degrees(each) - wanted) <= RESOLUTION[model] for each, wanted in pairs)


def test_the_example_of_the_datasheet():
    # BNO08X datasheet (CEVA), "UART-RVC": yaw 0.01, pitch -1.10, roll 20.85 degrees.
    stream = bytes.fromhex("aaaa de 0100 92ff 2508 8dfe ecff d103 000000 e7")
    (found,) = READERS["bno08x"]().feed(stream)
    assert near(found, (0.01, -1.10, 20.85), "bno08x")


@pytest.mark.parametrize("model", MODELS)
@given(orientations=st.lists(angles, max_size=8), sizes=st.lists(st.integers(0, 30), max_size=20))
def test_every_message_is_found_however_the_stream_is_cut(model, orientations, sizes):
    reader = READERS[model]()
    found = [
        each for piece in cut(b"".join(MESSAGES[model](*o) for o in orientations), sizes) for each in reader.feed(piece)
    ]
    assert all(near(each, wanted, model) for each, wanted in zip(found, orientations, strict=True))
    assert reader.refused == 0


@pytest.mark.parametrize("model", MODELS)
@given(garbage=st.binary(max_size=80), orientation=angles)
def test_messages_after_garbage_are_found(model, garbage, orientation):
    reader = READERS[model]()
    reader.feed(garbage)
    found = [each for _ in range(12) for each in reader.feed(MESSAGES[model](*orientation))]
    assert near(found[-1], orientation, model)
    assert len(found) >= 12 - 80 // reader.size - 1


@pytest.mark.parametrize("model", MODELS)
@given(orientation=angles, at=st.integers(0, 18), change=st.integers(1, 255))
def test_a_damaged_byte_costs_a_message_and_gives_no_wrong_one(model, orientation, at, change):
    message, reader = bytearray(MESSAGES[model](*orientation)), READERS[model]()
    at %= len(message)
    message[at] ^= change
    found = reader.feed(bytes(message) + b"".join(MESSAGES[model](*orientation) for _ in range(4)))
    assert found
    assert all(near(each, orientation, model) for each in found)


@pytest.mark.parametrize("model", MODELS)
@given(orientation=angles, lost=st.integers(0, 17), length=st.integers(1, 18))
def test_lost_bytes_cost_at_most_two_messages(model, orientation, lost, length):
    one, reader = MESSAGES[model](*orientation), READERS[model]()
    stream = one[:lost] + one[lost + length :] + one * 4
    # A checksum of 8 bits accepts one spliced message in 256: no reader can tell it from a whole one.
    assume(stream[: reader.size] == one or not reader._is_valid(stream[: reader.size]))
    found = reader.feed(stream)
    assert 3 <= len(found) <= 5
    assert all(near(each, orientation, model) for each in found)


@pytest.mark.parametrize("model", MODELS)
@given(noise=st.binary(max_size=600))
def test_noise_is_counted_and_kept_no_longer_than_a_message(model, noise):
    reader = READERS[model]()
    found = reader.feed(noise)
    kept = len(noise) - reader.refused - reader.size * len(found)
    assert kept >= 0
    assert len(reader._rest) < reader.size


@pytest.mark.parametrize("kind", [0x50, 0x51, 0x52, 0x54, 0x59])
def test_other_messages_of_a_witmotion_are_left_out(kind):
    reader = READERS["witmotion"]()
    assert reader.feed(witmotion(10, 20, 30, kind=kind)) == []
    assert reader.refused == 0


@pytest.mark.parametrize("message", [bno08x(0, 120, 0), bno08x(200, 0, 0), bno08x(0, 0, -200), witmotion(0, 91, 0)])
def test_impossible_angles_are_refused(message):
    for reader in (READERS["bno08x"](), READERS["witmotion"]()):
        assert reader.feed(message) == []
        assert reader.refused > 0


def test_an_incomplete_message_can_be_forgotten():
    reader = READERS["bno08x"]()
    reader.feed(bno08x(10)[:12])
    reader.forget()
    assert len(reader.feed(bno08x(20))) == 1
    assert reader.refused == 0
