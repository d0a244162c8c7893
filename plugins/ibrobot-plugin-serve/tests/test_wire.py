"""The wire format: what is encoded is decoded, damage is a WireError and nothing else, limits come before memory."""

from __future__ import annotations

import re
import struct
import tracemalloc
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from ibrobot_serve import wire
from ibrobot_serve.wire import (
    ALIGNMENT,
    Buffer,
    WireDecoder,
    WireEncoder,
    WireKind,
    WireLimits,
    WireMessage,
    decode,
    encode,
)

from ibrobot_core.api import PictureCodec
from ibrobot_core.app import WireError

PAGE = Path(__file__).parents[3] / "docs/reference/wire.md"
DTYPES = st.sampled_from(["?", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8", ">f4", ">i2"])
ARRAYS = DTYPES.flatmap(lambda code: hnp.arrays(code, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5)))
TEXTS = st.text(st.characters(codec="utf-8"), max_size=20)
I64 = st.integers(-(2**63), 2**63 - 1)
ANY = {
    "id": st.integers(0, 2**64 - 1),
    "robot": TEXTS,
    "fingerprint": TEXTS,
    "text": st.just("") | TEXTS,
    "tensors": st.dictionaries(TEXTS.filter(bool), ARRAYS, max_size=4),
    "stamp_ns": I64,
    "seed": I64,
    "latency_ms": st.floats(0, 1e9),
}
WAITS, COUNTS = st.integers(0, 2**63 - 1), st.integers(0, 2**64 - 1)
MESSAGES = st.builds(WireMessage, kind=st.just(WireKind.REQUEST), deadline_ns=WAITS, episode=COUNTS, **ANY) | st.builds(
    WireMessage, kind=st.sampled_from((WireKind.ANSWER, WireKind.FAILURE)), queued_ns=WAITS, pace_ns=COUNTS, **ANY
)
EXAMPLE = WireMessage(
    WireKind.REQUEST,
    7,
    {"state": np.array([0.5, -1.5], np.float32), "on": np.array([[True], [False]])},
    "so101",
    "3f2a",
    stamp_ns=1_700_000_000_000_000_000,
    deadline_ns=5_000_000_000,
    episode=2,
    seed=42,
)


def same(a: WireMessage, b: WireMessage) -> None:
    assert list(a.tensors) == list(b.tensors)
    for name, array in a.tensors.items():
        assert array.shape == b.tensors[name].shape
        assert array.dtype.newbyteorder("<") == b.tensors[name].dtype
        np.testing.assert_array_equal(array, b.tensors[name])
    texts = [attrs.asdict(each, filter=lambda field, _: field.name != "tensors") for each in (a, b)]
    assert texts[0] == texts[1]


@given(MESSAGES)
def test_what_is_encoded_is_decoded(message: WireMessage):
    same(message, decode(encode(message)))


@given(st.lists(MESSAGES, min_size=1, max_size=4))
def test_one_buffer_serves_one_frame_after_another(messages: list[WireMessage]):
    encoder, decoder, buffer = WireEncoder(), WireDecoder(), Buffer()
    for message in [*messages, *messages]:
        frame = encoder.encode(message, buffer.allocate)
        assert bytes(frame) == bytes(encode(message))
        decoded = decoder.decode(frame)
        same(message, decoded)  # its views are there still when the next frame is made


def test_robots_that_come_and_go_cost_no_memory():
    encoder, decoder = WireEncoder(), WireDecoder()

    def meet(robots: range) -> int:
        for number in robots:
            decoder.decode(encoder.encode(attrs.evolve(EXAMPLE, robot=f"robot {number}", text="x" * (number % 2))))
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        few = meet(range(1100))
        assert meet(range(1100, 2500)) < few + 200_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("robots", [64, 65, 300])
def test_robots_that_take_turns_are_laid_out_once(robots: int, monkeypatch: pytest.MonkeyPatch):
    laid_out: list[str] = []

    def counted(name: str) -> Any:
        work = getattr(wire, name)

        def count(*arguments: Any) -> Any:
            laid_out.append(name)
            return work(*arguments)

        return count

    for name in ("_lay_out", "_places"):
        monkeypatch.setattr(wire, name, counted(name))
    encoder, decoder = WireEncoder(), WireDecoder()
    for _ in range(3):
        for number in range(robots):
            decoder.decode(encoder.encode(attrs.evolve(EXAMPLE, robot=f"robot {number}")))
    assert len(laid_out) == 2 * robots, "by the encoder and the decoder"


def test_tensors_are_aligned_read_only_views():
    frame = encode(EXAMPLE)
    memory = np.frombuffer(frame, np.uint8)
    for array in decode(frame).tensors.values():
        assert np.shares_memory(array, memory)
        offset = array.__array_interface__["data"][0] - memory.__array_interface__["data"][0]
        assert offset % ALIGNMENT == 0
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


@settings(max_examples=200)
@given(MESSAGES, st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=5), st.integers(-40, 40))
def test_damage_is_a_wire_error_or_another_message(message: WireMessage, changes: list[tuple[int, int]], longer: int):
    frame = bytearray(encode(message))
    for at, value in changes:
        frame[at % len(frame)] = value
    frame = frame + bytes(longer) if longer > 0 else frame[: len(frame) + longer]
    knowing = WireDecoder()
    knowing.decode(encode(message))
    try:
        decoded = decode(frame)
    except WireError as error:
        with pytest.raises(WireError, match=re.escape(str(error))):
            knowing.decode(frame)
        return
    assert bytes(encode(decoded)) == bytes(encode(knowing.decode(frame))), "what came before changes nothing"
    assert bytes(encode(decoded))[:8] == bytes(frame)[:8], "what is accepted can be said again"


@given(st.binary(max_size=300))
def test_garbage_is_a_wire_error(payload: bytes):
    with pytest.raises(WireError):
        decode(payload)


TABLE = 80 + len("so101") + len("3f2a")


@pytest.mark.parametrize(
    ("at", "form", "value", "said"),
    [
        (0, "4s", b"HTTP", "not a frame"),
        (4, "<H", 2, "version 2; this side speaks version 1"),
        (6, "B", 9, "unknown kind 9"),
        (7, "B", 1, "reserved bytes"),
        (79, "B", 1, "reserved bytes"),
        (24, "<q", -1, "deadline"),
        (48, "<d", float("nan"), "latency of nan"),
        (56, "<Q", 10 * 2**30, f"states a size of {10 * 2**30}"),
        (68, "<H", 65535, "over the limits"),
        (64, "<I", 2**32 - 1, "over the limits"),
        (68, "<H", 3, "a tensor of"),
        (68, "<H", 1, "wrong offset|after the last tensor"),
        (80, "B", 0xFF, "not UTF-8"),
        (TABLE, "<Q", 0, "at the wrong offset"),
        (TABLE + 8, "<Q", 2**63, "at the wrong offset"),
        (TABLE + 16, "B", 77, "unknown dtype 77"),
        (TABLE + 16, "B", 128, "JPEG, which this side does not support|expected"),
        (TABLE + 17, "B", 200, "over the limits"),
        (TABLE + 18, "<H", 0, "over the limits"),
        (TABLE + 20, "<I", 10 * 2**20, "in 8 bytes"),
        (TABLE + 20, "<I", 2**32 - 1, "in 8 bytes"),
    ],
)
def test_false_claims_are_named(at: int, form: str, value: Any, said: str):
    frame = bytearray(encode(EXAMPLE))
    struct.pack_into(form, frame, at, value)
    with pytest.raises(WireError, match=said):
        decode(frame)


def test_a_claim_of_ten_gigabytes_costs_no_memory():
    frame = bytearray(encode(WireMessage(WireKind.REQUEST, 1, {"a": np.zeros((1, 1, 1, 1), np.float64)})))
    struct.pack_into("<4I", frame, 80 + 20, *(2**32 - 1, 0, 2**32 - 1, 2**32 - 1))
    tracemalloc.start()
    try:
        with pytest.raises(WireError, match="in 8 bytes"):
            decode(frame)
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()


def test_booleans_are_zero_or_one():
    frame = bytearray(encode(WireMessage(WireKind.REQUEST, 1, {"on": np.array([True])})))
    frame[-1] = 2
    with pytest.raises(WireError, match="booleans other than 0 and 1"):
        decode(frame)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"tensors": {"o": np.array([object()])}}, "'o' has dtype object"),
        ({"tensors": {"t": np.array("text")}}, "'t' has dtype <U4"),
        ({"tensors": {"c": np.zeros(1, complex)}}, "complex"),
        ({"tensors": {"": np.zeros(1)}}, "needs a name"),
        ({"tensors": {"deep": np.zeros((1,) * 9)}}, "9 dimensions"),
        ({"tensors": {str(i): np.zeros(1) for i in range(65)}}, "65 tensors are more than 64"),
        ({"tensors": {"x" * 129: np.zeros(1)}}, "129 bytes"),
        ({"robot": "ü" * 65}, "130 bytes"),
        ({"id": -1}, "does not fit into a frame"),
        ({"seed": 2**63}, "does not fit into a frame"),
    ],
)
def test_contents_that_do_not_fit_into_a_frame_are_refused(changed: dict[str, Any], said: str):
    with pytest.raises(WireError, match=said):
        encode(attrs.evolve(EXAMPLE, **changed))


def test_both_sides_keep_to_the_limits():
    limits = WireLimits(size=256)
    message = WireMessage(WireKind.REQUEST, 1, {"a": np.zeros(200, np.uint8)})
    with pytest.raises(WireError, match="larger than 256"):
        encode(message, limits=limits)
    with pytest.raises(WireError, match="a frame has 80 to 256"):
        decode(encode(message), limits=limits)


class Halves(PictureCodec):
    """Stands for JPEG: every other row of the picture, after its size."""

    answer: object = None

    @override
    def encode(self, name: str, picture: np.ndarray) -> bytes | None:
        return None if name == "mask" else struct.pack("<3I", *picture.shape) + picture[::2].tobytes()

    @override
    def decode(self, jpeg: memoryview, shape: tuple[int, int, int]) -> np.ndarray:
        if self.answer is not None:
            if isinstance(self.answer, Exception):
                raise self.answer
            return self.answer  # type: ignore[return-value]
        height, width, channels = struct.unpack_from("<3I", jpeg)
        rows = np.frombuffer(jpeg[12:], np.uint8).reshape(-1, width, channels)
        return np.repeat(rows, 2, axis=0)[:height]


PICTURES = WireMessage(
    WireKind.REQUEST,
    1,
    {
        "top": np.arange(48, dtype=np.uint8).reshape(4, 4, 3),
        "mask": np.ones((4, 4, 1), np.uint8),
        "normalised": np.ones((4, 4, 3), np.float32),
    },
)


def test_pictures_travel_as_their_codec_says_and_all_else_as_it_is():
    decoded = decode(encode(PICTURES, codec=Halves()), codec=Halves()).tensors
    np.testing.assert_array_equal(decoded["top"][::2], PICTURES.tensors["top"][::2])
    np.testing.assert_array_equal(decoded["top"][1::2], PICTURES.tensors["top"][::2])
    assert not decoded["top"].flags.writeable
    for name in ("mask", "normalised"):
        np.testing.assert_array_equal(decoded[name], PICTURES.tensors[name])


def test_jpeg_without_a_codec_is_refused():
    with pytest.raises(WireError, match="'top': JPEG, which this side does not support"):
        decode(encode(PICTURES, codec=Halves()))


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (RuntimeError("not a JPEG"), "RuntimeError: not a JPEG"),
        (np.zeros((4, 5, 3), np.uint8), "as announced"),
        (np.zeros((4, 4, 3), np.float32), "as announced"),
    ],
)
def test_undecodable_picture_is_a_wire_error(answer: object, said: str):
    codec = Halves()
    frame = encode(PICTURES, codec=codec)
    codec.answer = answer
    with pytest.raises(WireError, match=said):
        decode(frame, codec=codec)


def test_a_small_jpeg_that_claims_a_large_picture_is_not_decoded():
    frame = bytearray(encode(WireMessage(WireKind.REQUEST, 1, {"top": PICTURES.tensors["top"]}), codec=Halves()))
    struct.pack_into("<2I", frame, 100, 40000, 40000)
    codec = Halves()
    codec.answer = AssertionError("it was decoded")
    with pytest.raises(WireError, match="larger than"):
        decode(frame, codec=codec)


def test_answers_of_older_servers_say_nothing_of_waiting_and_pace():
    """As version 1 was before: the two fields were 0 in answers."""
    old = bytearray(encode(WireMessage(WireKind.ANSWER, 7, {"action": np.zeros(2)}, "so101", "3f2a", latency_ms=20.0)))
    assert old[24:40] == bytes(16)
    answer = decode(old)
    assert (answer.queued_ns, answer.pace_ns, answer.deadline_ns, answer.episode) == (0, 0, 0, 0)


@pytest.mark.parametrize("kind", [WireKind.ANSWER, WireKind.FAILURE])
def test_waiting_and_pace_lie_where_a_request_has_deadline_and_episode(kind: WireKind):
    frame = encode(WireMessage(kind, 7, queued_ns=30_000_000, pace_ns=750_000_000))
    assert struct.unpack_from("<qQ", frame, 24) == (30_000_000, 750_000_000)
    assert bytes(frame[:24]) == bytes(encode(WireMessage(kind, 7)))[:24], "the rest is as it was"


def test_the_documented_example_is_what_is_sent():
    dump = PAGE.read_text().split("```text\n")[1].split("```")[0]
    documented = bytes.fromhex("".join(line.split("|")[0].partition(":")[2] for line in dump.splitlines()))
    assert documented == bytes(encode(EXAMPLE))
    same(decode(documented), EXAMPLE)
