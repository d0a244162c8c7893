"""The wire format between a robot and where its model runs: a fixed head, texts, a table of tensors, their bytes.

`docs/reference/wire.md` describes it byte by byte. Nothing that is received is evaluated, and every claim that a frame
makes about itself is checked against its length and the limits before anything is made of it.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Callable, Mapping
from typing import override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import WireError
from ibrobot_core.interfaces import Payload, PictureCodec, Tensors

MAGIC = b"IBRW"
VERSION = 1
ALIGNMENT = 64
"""Bytes; every tensor's buffer begins at a multiple of it, counted from the frame's first byte."""

_HEAD = struct.Struct("<4sHBxQqqQqdQIHHH6x")
_ENTRY = struct.Struct("<QQBBH")
_DTYPES = tuple(
    np.dtype(code) for code in ("?", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
)
_CODES = {dtype: code for code, dtype in enumerate(_DTYPES, 1)}
_JPEG = 128
_BYTE = np.dtype(np.uint8)


class Kind(enum.IntEnum):
    """What a frame is."""

    REQUEST = 1
    """Tensors for `infer`."""
    ANSWER = 2
    """Its outputs."""
    FAILURE = 3
    """Why there are none, in `text`."""


@attrs.frozen
class Limits:
    """What a frame may at most be; all are checked before anything is allocated."""

    size: int = 64 * 1024 * 1024
    """Bytes of a frame, and of its pictures once decoded."""
    tensors: int = 64
    ndim: int = 8
    name: int = 128
    """Bytes of a tensor's name, of a robot's, and of a fingerprint."""
    text: int = 64 * 1024
    """Bytes."""


LIMITS = Limits()


@attrs.frozen(eq=False)
class Message:
    """A frame, decoded."""

    kind: Kind
    id: int
    """Of the request; its answer carries the same."""
    tensors: Tensors = attrs.field(factory=dict)
    robot: str = ""
    """Who asks: unique among a server's robots."""
    fingerprint: str = ""
    """Of the sender's policy."""
    text: str = ""
    stamp_ns: int = 0
    """When the robot sent the request, by its own clock; the answer repeats it."""
    deadline_ns: int = 0
    """For how long from its arrival on anybody waits for the answer [ns]; no clock needs to agree with another."""
    episode: int = 0
    """Counts the robot's episodes; a policy that remembers is reset with `seed` where it changes."""
    seed: int = 0
    latency_ms: float = 0.0
    """In an answer: from the request's arrival at the server to its answer."""


class NoPictures(PictureCodec):
    """Sends all tensors as they are, and takes no JPEG."""

    @override
    def encode(self, name: str, picture: NDArray[np.uint8]) -> bytes | None:
        return None

    @override
    def decode(self, jpeg: memoryview, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
        raise WireError("JPEG, which is not spoken here")


@attrs.frozen(eq=False)
class _Placed:
    """A tensor, or its JPEG, and its entry in the table."""

    array: NDArray[np.generic]
    code: int
    shape: tuple[int, ...]
    name: bytes
    offset: int


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT


def encode(
    message: Message, allocate: Callable[[int], memoryview] = lambda size: memoryview(bytearray(size)), *,
    limits: Limits = LIMITS, codec: PictureCodec | None = None,
) -> memoryview:  # fmt: skip
    """A frame; every tensor is copied once, to where it is sent from.

    Args:
        message: what to say.
        allocate: gives writable memory of so many bytes, or more.
        limits: those of the receiver.
        codec: makes JPEG of camera pictures: their pixels change.

    Raises:
        WireError: for what has no place in a frame, e.g. a tensor of objects, or more than the limits allow.
    """
    robot, fingerprint = (_text(text, limits.name) for text in (message.robot, message.fingerprint))
    text = _text(message.text, limits.text)
    if len(message.tensors) > limits.tensors:
        raise WireError(f"{len(message.tensors)} tensors are more than {limits.tensors}")
    stored = [(_text(name, limits.name), *_stored(name, array, codec)) for name, array in message.tensors.items()]
    cursor = _HEAD.size + len(robot) + len(fingerprint) + len(text)
    cursor += sum(_ENTRY.size + 4 * len(shape) + len(name) for name, _, _, shape in stored)
    placed = []
    for name, array, code, shape in stored:
        if len(shape) > limits.ndim or not name:
            raise WireError(
                f"tensor {name.decode()!r} with {len(shape)} dimensions; it needs a name, and at most {limits.ndim}"
            )
        placed.append(_Placed(array, code, shape, name, offset := _aligned(cursor)))
        cursor = offset + array.nbytes
    if cursor > limits.size:
        raise WireError(f"a frame of {cursor} bytes is larger than {limits.size}")
    frame = allocate(cursor)[:cursor]
    try:
        _HEAD.pack_into(
            frame, 0, MAGIC, VERSION, message.kind, message.id, message.stamp_ns, message.deadline_ns, message.episode,
            message.seed, message.latency_ms, cursor, len(text), len(placed), len(robot), len(fingerprint),
        )  # fmt: skip
    except struct.error as error:
        raise WireError(f"a number of request {message.id} has no place in a frame: {error}") from None
    _write(frame, robot + fingerprint + text, placed)
    return frame


def _write(frame: memoryview, texts: bytes, placed: list[_Placed]) -> None:
    end = _HEAD.size + len(texts)
    frame[_HEAD.size : end] = texts
    for entry in placed:
        _ENTRY.pack_into(frame, end, entry.offset, entry.array.nbytes, entry.code, len(entry.shape), len(entry.name))
        end += _ENTRY.size
        row = struct.pack(f"<{len(entry.shape)}I", *entry.shape) + entry.name
        frame[end : end + len(row)] = row
        end += len(row)
    for entry in placed:
        frame[end : entry.offset] = bytes(entry.offset - end)
        array = entry.array
        np.ndarray(array.shape, array.dtype.newbyteorder("<"), frame, entry.offset)[...] = array
        end = entry.offset + array.nbytes


def _text(text: str, most: int) -> bytes:
    encoded = text.encode(errors="replace")
    if len(encoded) > most:
        raise WireError(f"{text[:40]!r}… has {len(encoded)} bytes, more than {most}")
    return encoded


def _stored(
    name: str, array: NDArray[np.generic], codec: PictureCodec | None
) -> tuple[NDArray[np.generic], int, tuple[int, ...]]:
    """What goes into the buffer, the code of its dtype, and the tensor's shape."""
    code = _CODES.get(array.dtype.newbyteorder("<"))
    if code is None:
        raise WireError(f"tensor {name!r} has dtype {array.dtype}; only numbers and booleans of 1 to 8 bytes travel")
    if codec is not None and array.dtype == _BYTE and array.ndim == 3 and array.shape[2] in (1, 3):
        jpeg = codec.encode(name, array.view(np.uint8))
        if jpeg is not None:
            return np.frombuffer(jpeg, np.uint8), _JPEG, array.shape
    return array, code, array.shape


class Encoder:
    """Encodes into one buffer that it keeps: a frame is good until the next is made."""

    def __init__(self, limits: Limits = LIMITS, codec: PictureCodec | None = None) -> None:
        self._limits = limits
        self._codec = codec
        self._buffer = bytearray()

    def encode(self, message: Message) -> bytearray:
        """As the function `encode`."""
        encode(message, self._allocate, limits=self._limits, codec=self._codec).release()
        return self._buffer

    def _allocate(self, size: int) -> memoryview:
        """The buffer at this size: fresh memory for a large frame costs more than to fill it."""
        try:
            if size < len(self._buffer):
                del self._buffer[size:]
            else:
                self._buffer.extend(bytes(size - len(self._buffer)))
        except BufferError:  # somebody still looks at the last frame
            self._buffer = bytearray(size)
        return memoryview(self._buffer)


def decode(payload: Payload, *, limits: Limits = LIMITS, codec: PictureCodec | None = None) -> Message:
    """A message whose tensors are read-only views of `payload`: nothing is copied, but for JPEG.

    Raises:
        WireError: for anything but a whole frame within the limits.
    """
    frame = memoryview(payload).toreadonly()
    if not _HEAD.size <= len(frame) <= limits.size:
        raise WireError(f"{len(frame)} bytes; a frame has {_HEAD.size} to {limits.size}")
    (
        magic, version, kind, request, stamp_ns, deadline_ns, episode, seed, latency_ms, size, text_size, count,
        robot_size, fingerprint_size,
    ) = _HEAD.unpack_from(frame)  # fmt: skip
    if magic != MAGIC:
        raise WireError(f"no frame: it begins with {magic!r}, not {MAGIC!r}")
    if version != VERSION:
        raise WireError(f"a frame of version {version}; this side speaks version {VERSION}")
    if frame[7] or any(frame[_HEAD.size - 6 : _HEAD.size]):
        raise WireError("a frame whose reserved bytes are not 0")
    if kind not in Kind:
        raise WireError(f"a frame of the unknown kind {kind}")
    if size != len(frame):
        raise WireError(f"a frame that says {size} bytes has {len(frame)}")
    if count > limits.tensors or max(robot_size, fingerprint_size) > limits.name or text_size > limits.text:
        raise WireError(
            f"{count} tensors, texts of {robot_size}, {fingerprint_size}, {text_size} bytes: over the limits"
        )
    if deadline_ns < 0 or not 0 <= latency_ms < math.inf:
        raise WireError(f"a deadline of {deadline_ns} ns, a latency of {latency_ms} ms")
    reader = _Reader(frame, _HEAD.size)
    robot, fingerprint, text = (reader.text(n) for n in (robot_size, fingerprint_size, text_size))
    tensors = _tensors(reader, count, limits, codec or NoPictures())
    return Message(
        Kind(kind), request, tensors, robot, fingerprint, text, stamp_ns, deadline_ns, episode, seed, latency_ms
    )


@attrs.define
class _Reader:
    """Reads a frame's table from `at` on, never beyond its end."""

    frame: memoryview
    at: int

    def take(self, size: int) -> memoryview:
        begin, self.at = self.at, self.at + size
        if self.at > len(self.frame):
            raise WireError(f"a frame of {len(self.frame)} bytes whose table reaches to {self.at}")
        return self.frame[begin : self.at]

    def text(self, size: int) -> str:
        try:
            return str(self.take(size), "utf-8")
        except UnicodeDecodeError:
            raise WireError("a text that is not UTF-8") from None


def _tensors(reader: _Reader, count: int, limits: Limits, codec: PictureCodec) -> Mapping[str, NDArray[np.generic]]:
    table = []
    for _ in range(count):
        offset, nbytes, code, ndim, name_size = _ENTRY.unpack(reader.take(_ENTRY.size))
        if ndim > limits.ndim or not 0 < name_size <= limits.name:
            raise WireError(f"a tensor of {ndim} dimensions with a name of {name_size} bytes: over the limits")
        shape = struct.unpack(f"<{ndim}I", reader.take(4 * ndim))
        table.append((reader.text(name_size), code, shape, offset, nbytes))
    tensors: dict[str, NDArray[np.generic]] = {}
    cursor, decoded = reader.at, 0
    for name, code, shape, offset, nbytes in table:
        if name in tensors:
            raise WireError(f"two tensors named {name!r}")
        if offset != _aligned(cursor) or offset + nbytes > len(reader.frame):
            raise WireError(f"tensor {name!r}: {nbytes} bytes at {offset} are not where they belong")
        cursor = offset + nbytes
        # A dimension of zero must not hide the others from the limit.
        elements = math.prod(max(1, n) for n in shape)
        if code == _JPEG:
            decoded += elements
            if decoded > limits.size:
                raise WireError(f"picture {name!r} of shape {shape} is larger than {limits.size} bytes")
            tensors[name] = _picture(name, reader.frame[offset:cursor], shape, codec)
        else:
            tensors[name] = _view(name, reader.frame, code, shape, elements, offset, nbytes, limits)
    if cursor != len(reader.frame):
        raise WireError(f"{len(reader.frame) - cursor} bytes that belong to nothing")
    return tensors


def _view(
    name: str, frame: memoryview, code: int, shape: tuple[int, ...], elements: int, offset: int, nbytes: int,
    limits: Limits,
) -> NDArray[np.generic]:  # fmt: skip
    if not 0 < code <= len(_DTYPES):
        raise WireError(f"tensor {name!r} of the unknown dtype {code}")
    dtype = _DTYPES[code - 1]
    if elements * dtype.itemsize > limits.size or math.prod(shape) * dtype.itemsize != nbytes:
        raise WireError(f"tensor {name!r} of shape {shape} and dtype {dtype} in {nbytes} bytes")
    if dtype.kind == "b" and any(np.frombuffer(frame[offset : offset + nbytes], np.uint8) > 1):
        raise WireError(f"tensor {name!r} has booleans other than 0 and 1")
    return np.ndarray(shape, dtype, frame, offset)


def _picture(name: str, jpeg: memoryview, shape: tuple[int, ...], codec: PictureCodec) -> NDArray[np.uint8]:
    if len(shape) != 3 or shape[2] not in (1, 3) or 0 in shape:
        raise WireError(f"picture {name!r} of shape {shape}, expected (height, width, 3 or 1)")
    try:
        picture = codec.decode(jpeg, (shape[0], shape[1], shape[2]))
    except WireError as error:
        raise WireError(f"picture {name!r}: {error}") from None
    except Exception as error:  # contained: a decoder may fail in any way over what a stranger sent
        raise WireError(f"picture {name!r}: {type(error).__name__}: {error}") from error
    if picture.shape != shape or picture.dtype != _BYTE:
        raise WireError(f"picture {name!r} is {picture.dtype} {picture.shape}, not the {shape} that was announced")
    picture.flags.writeable = False
    return picture
