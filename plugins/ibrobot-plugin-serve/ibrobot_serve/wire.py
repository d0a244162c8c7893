"""The wire format between a robot and its model: a fixed header, texts, a table of tensors, and their bytes.

`docs/reference/wire.md` describes it byte by byte. Nothing that is received is evaluated, and every size that
a frame states is checked against its length and the limits before it is used.
"""

from __future__ import annotations

import enum
import hashlib
import math
import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Payload, PictureCodec, Tensors
from ibrobot_core.app import WireError

MAGIC = b"IBRW"
VERSION = 1
ALIGNMENT = 64
"""Alignment of tensors [bytes], counted from the frame's first byte."""

_NUMBERS = struct.Struct("<4sHBBQqqQqd")
_SIZES = struct.Struct("<QIHHH6s")
_HEAD_SIZE = _NUMBERS.size + _SIZES.size
_ENTRY = struct.Struct("<QQBBH")
_OFFSET_SIZE = 8
"""Bytes of the offset with which an entry begins."""
_ZEROS = bytes(6)
_DTYPES = tuple(
    np.dtype(code) for code in ("?", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
)
_CODES = {dtype: code for code, dtype in enumerate(_DTYPES, 1)}
_JPEG = 128
_BYTE = np.dtype(np.uint8)
_LAYOUTS_KEPT = 512
"""Usually one per robot, and more than a server has robots. Each takes about 2 kB."""


def service_name(model: str) -> str:
    """Name of a model's service on a transport."""
    return f"infer/{model}"


def health_name(model: str) -> str:
    """Name of its health service."""
    return f"{service_name(model)}/health"


def offer_name(model: str, server: str = "") -> str:
    """Name of the service with which one of a model's servers accepts robots; without `server`, their prefix."""
    return f"{service_name(model)}/offer/{server}"


def server_name(model: str, server: str) -> str:
    """Name of the service of one of a model's servers."""
    return f"{service_name(model)}/at/{server}"


def whole_fingerprint(fingerprint: str, weights: str) -> str:
    """Fingerprint of a policy with its weights. Requests and answers carry it, so that each side notices changes.

    Args:
        fingerprint: `Policy.fingerprint`.
        weights: `Policy.weights`.
    """
    return hashlib.sha256(f"{fingerprint}\0{weights}".encode()).hexdigest()[:32] if weights else fingerprint


class WireKind(enum.IntEnum):
    """The kinds of frames."""

    REQUEST = 1
    """Tensors for `infer`."""
    ANSWER = 2
    """Its outputs."""
    FAILURE = 3
    """The reason for the lack of outputs, in `text`."""
    REFUSAL = 4
    """The reason why this server refuses the request, in `text`; another server may take it."""


_KINDS = {kind.value: kind for kind in WireKind}


@attrs.frozen
class WireLimits:
    """Upper limits of a frame, checked before anything is allocated."""

    size: int = 64 * 1024 * 1024
    """Bytes of a frame, and of its pictures once decoded."""
    tensors: int = 64
    ndim: int = 8
    name: int = 128
    """Bytes of a tensor's name, of a robot's, and of a fingerprint."""
    text: int = 64 * 1024
    """Bytes."""


WIRE_LIMITS = WireLimits()


@attrs.frozen(eq=False)
class WireMessage:
    """A frame, decoded."""

    kind: WireKind
    id: int
    """Number of the request; its answer carries the same."""
    tensors: Tensors = attrs.field(factory=dict)
    robot: str = ""
    """Name of the sender, unique among a server's robots."""
    fingerprint: str = ""
    """Fingerprint of the sender's policy."""
    text: str = ""
    stamp_ns: int = 0
    """When the robot sent the request, by its own clock; the answer repeats it."""
    deadline_ns: int = 0
    """In a request: deadline of the answer after the request's arrival [ns]. Needs no common clock."""
    episode: int = 0
    """In a request: number of the robot's episode; a change resets a stateful policy with `seed`."""
    seed: int = 0
    latency_ms: float = 0.0
    """In an answer: from the request's arrival at the server to its answer."""
    queued_ns: int = 0
    """In an answer: the part of `latency_ns` for which the request waited for its turn [ns]."""
    pace_ns: int = 0
    """In an answer or a failure: minimum time between the robot's requests [ns]; 0: none."""


@attrs.frozen(eq=False)
class _Place:
    """Position of a tensor, or of its JPEG, in a frame."""

    name: str
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    offset: int
    nbytes: int
    jpeg: bool


@attrs.frozen(eq=False)
class _MessageLayout:
    """Everything in a frame except its numbers and its tensors' values; usually equal for all requests of a robot."""

    robot: str
    fingerprint: str
    text: str
    places: Sequence[_Place]
    head: bytes
    """The bytes between the numbers and the tensors."""
    size: int
    """Size of the whole frame [bytes]."""


class _Layouts[K: Hashable]:
    """Cache of the most recent layouts. Thread-safe."""

    def __init__(self) -> None:
        self._kept: OrderedDict[K, _MessageLayout] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: K) -> _MessageLayout | None:
        with self._lock:
            layout = self._kept.get(key)
            if layout is not None:
                self._kept.move_to_end(key)
            return layout

    def keep(self, key: K, layout: _MessageLayout) -> None:
        with self._lock:
            self._kept[key] = layout
            if len(self._kept) > _LAYOUTS_KEPT:
                self._kept.popitem(last=False)


def _aligned(offset: int) -> int:
    return -(-offset // ALIGNMENT) * ALIGNMENT


def _jpegs(tensors: Tensors, codec: PictureCodec) -> Mapping[str, bytes]:
    """Encode the pictures that the codec accepts. Returns name -> JPEG."""
    jpegs = {}
    for name, array in tensors.items():
        if array.dtype == _BYTE and array.ndim == 3 and array.shape[2] in (1, 3):
            jpeg = codec.encode(name, array.view(np.uint8))
            if jpeg is not None:
                jpegs[name] = jpeg
    return jpegs


def _lay_out(message: WireMessage, jpegs: Mapping[str, bytes], limits: WireLimits) -> _MessageLayout:
    texts = [_text(text, limits.name) for text in (message.robot, message.fingerprint)]
    texts.append(_text(message.text, limits.text))
    if len(message.tensors) > limits.tensors:
        raise WireError(f"{len(message.tensors)} tensors are more than {limits.tensors}")
    rows = []
    for name, array in message.tensors.items():
        if array.ndim > limits.ndim or not name:
            raise WireError(f"tensor {name!r} with {array.ndim} dimensions; it needs a name, and at most {limits.ndim}")
        rows.append(struct.pack(f"<{array.ndim}I", *array.shape) + _text(name, limits.name))
    cursor = _HEAD_SIZE + sum(map(len, texts)) + sum(_ENTRY.size + len(row) for row in rows)
    places, table = list[_Place](), b""
    for (name, array), row in zip(message.tensors.items(), rows, strict=True):
        dtype, jpeg = array.dtype.newbyteorder("<"), jpegs.get(name)
        code = _CODES.get(dtype) if jpeg is None else _JPEG
        if code is None:
            raise WireError(f"tensor {name!r} has dtype {dtype}; only numbers and booleans of 1 to 8 bytes can be sent")
        offset, nbytes = _aligned(cursor), array.nbytes if jpeg is None else len(jpeg)
        places.append(_Place(name, dtype, array.shape, offset, nbytes, jpeg is not None))
        table += _ENTRY.pack(offset, nbytes, code, array.ndim, len(row) - 4 * array.ndim) + row
        cursor = offset + nbytes
    if cursor > limits.size:
        raise WireError(f"a frame of {cursor} bytes is larger than {limits.size}")
    robot, fingerprint, text = map(len, texts)
    head = b"".join((_SIZES.pack(cursor, text, len(places), robot, fingerprint, _ZEROS), *texts, table))
    if places:
        head = head.ljust(places[0].offset - _NUMBERS.size, b"\0")
    return _MessageLayout(message.robot, message.fingerprint, message.text, places, head, cursor)


def _fill(frame: memoryview, layout: _MessageLayout, message: WireMessage, jpegs: Mapping[str, bytes]) -> memoryview:
    asks = message.kind is WireKind.REQUEST
    times = (message.deadline_ns, message.episode) if asks else (message.queued_ns, message.pace_ns)
    try:
        _NUMBERS.pack_into(
            frame, 0, MAGIC, VERSION, message.kind, 0, message.id, message.stamp_ns, *times, message.seed,
            message.latency_ms,
        )  # fmt: skip
    except struct.error as error:
        raise WireError(f"a number of request {message.id} does not fit into a frame: {error}") from None
    end = _NUMBERS.size + len(layout.head)
    frame[_NUMBERS.size : end] = layout.head
    for place in layout.places:
        frame[end : place.offset] = bytes(place.offset - end)
        end = place.offset + place.nbytes
        if place.jpeg:
            frame[place.offset : end] = jpegs[place.name]
        else:
            np.ndarray(place.shape, place.dtype, frame, place.offset)[...] = message.tensors[place.name]
    return frame


def _text(text: str, most: int) -> bytes:
    encoded = text.encode(errors="replace")
    if len(encoded) > most:
        raise WireError(f"{text[:40]!r}… has {len(encoded)} bytes, more than {most}")
    return encoded


def _fresh(size: int) -> memoryview:
    return memoryview(bytearray(size))


class Buffer:
    """Memory reused for consecutive frames, since allocating a large frame takes longer than filling it."""

    def __init__(self) -> None:
        self._memory = bytearray()

    def allocate(self, size: int) -> memoryview:
        """Return `size` bytes of a reused buffer; a frame is valid until the next call."""
        try:
            if size < len(self._memory):
                del self._memory[size:]
            else:
                self._memory.extend(bytes(size - len(self._memory)))
        except BufferError:  # a reader still holds the last frame
            self._memory = bytearray(size)
        return memoryview(self._memory)


class WireEncoder:
    """Encodes messages, faster if they differ from earlier ones only in numbers and values.

    Args:
        limits: limits of the receiver.
        codec: encodes camera pictures as JPEG, which changes their pixels.
    """

    def __init__(self, limits: WireLimits = WIRE_LIMITS, codec: PictureCodec | None = None) -> None:
        self._limits = limits
        self._codec = codec
        self._layouts: _Layouts[Hashable] = _Layouts()

    def encode(self, message: WireMessage, allocate: Callable[[int], memoryview] = _fresh) -> memoryview:
        """Encode a frame, copying each tensor once. Thread-safe.

        Args:
            message: the message.
            allocate: returns writable memory of at least the given number of bytes.

        Raises:
            WireError: for contents that a frame cannot hold, e.g. a tensor of objects, or that exceed the limits.
        """
        jpegs = _jpegs(message.tensors, self._codec) if self._codec is not None else {}
        key = (
            message.robot,
            message.fingerprint,
            message.text,
            *[(name, array.dtype, array.shape) for name, array in message.tensors.items()],
        )
        layout = self._layouts.get(key) if not jpegs else None
        if layout is None:
            layout = _lay_out(message, jpegs, self._limits)
            if not (jpegs or message.text):
                self._layouts.keep(key, layout)
        return _fill(allocate(layout.size)[: layout.size], layout, message, jpegs)


def encode(message: WireMessage, *, limits: WireLimits = WIRE_LIMITS, codec: PictureCodec | None = None) -> memoryview:
    """As `WireEncoder.encode`, for a single message."""
    return WireEncoder(limits, codec).encode(message)


def decode(payload: Payload, *, limits: WireLimits = WIRE_LIMITS, codec: PictureCodec | None = None) -> WireMessage:
    """As `WireDecoder.decode`, for a single frame."""
    return WireDecoder(limits, codec).decode(payload)


class WireDecoder:
    """Decodes frames, faster if they differ from earlier ones only in numbers and values.

    Args:
        limits: a frame beyond them is refused.
        codec: decodes JPEG pictures; without it they are refused.
    """

    def __init__(self, limits: WireLimits = WIRE_LIMITS, codec: PictureCodec | None = None) -> None:
        self._limits = limits
        self._codec = codec
        self._layouts: _Layouts[bytes] = _Layouts()
        """Bytes of `head` -> layout."""

    def decode(self, payload: Payload) -> WireMessage:
        """Decode a frame. Tensors are read-only views of `payload`, except for JPEG pictures. Thread-safe.

        Raises:
            WireError: for anything but a whole frame within the limits.
        """
        frame = memoryview(payload).toreadonly()
        if not _HEAD_SIZE <= len(frame) <= self._limits.size:
            raise WireError(f"{len(frame)} bytes; a frame has {_HEAD_SIZE} to {self._limits.size}")
        magic, version, kind, reserved, request, stamp_ns, *times, seed, latency_ms = _NUMBERS.unpack_from(frame)
        if magic != MAGIC:
            raise WireError(f"not a frame: it begins with {magic!r}, not {MAGIC!r}")
        if version != VERSION:
            raise WireError(f"a frame of version {version}; this side speaks version {VERSION}")
        if kind not in _KINDS:
            raise WireError(f"a frame of the unknown kind {kind}")
        if times[0] < 0 or not 0 <= latency_ms < math.inf:
            raise WireError(f"a deadline or wait of {times[0]} ns, a latency of {latency_ms} ms")
        layout = self._laid_out(frame, reserved)
        tensors = {}
        for place in layout.places:
            if place.jpeg:
                tensors[place.name] = self._picture(frame, place)
                continue
            array = tensors[place.name] = np.ndarray(place.shape, place.dtype, frame, place.offset)
            if place.dtype.kind == "b" and np.any(array.view(np.uint8) > 1):
                raise WireError(f"tensor {place.name!r} has booleans other than 0 and 1")
        (deadline_ns, episode), (queued_ns, pace_ns) = (times, (0, 0)) if kind == WireKind.REQUEST else ((0, 0), times)
        return WireMessage(
            _KINDS[kind], request, tensors, layout.robot, layout.fingerprint, layout.text, stamp_ns, deadline_ns,
            episode, seed, latency_ms, queued_ns, pace_ns,
        )  # fmt: skip

    def _laid_out(self, frame: memoryview, reserved: int) -> _MessageLayout:
        limits = self._limits
        size, text_size, count, robot_size, fingerprint_size, zeros = _SIZES.unpack_from(frame, _NUMBERS.size)
        if reserved or zeros != _ZEROS:
            raise WireError("a frame whose reserved bytes are not 0")
        if size != len(frame):
            raise WireError(f"a frame of {len(frame)} bytes states a size of {size}")
        if count > limits.tensors or max(robot_size, fingerprint_size) > limits.name or text_size > limits.text:
            raise WireError(
                f"{count} tensors, texts of {robot_size}, {fingerprint_size}, {text_size} bytes: over the limits"
            )
        end = table = _HEAD_SIZE + robot_size + fingerprint_size + text_size
        if count and table + _OFFSET_SIZE <= size:
            # The table ends where the first tensor begins; reading it checks that.
            longest = count * (_ENTRY.size + 4 * limits.ndim + limits.name) + ALIGNMENT
            end = min(int.from_bytes(frame[table : table + _OFFSET_SIZE], "little"), table + longest)
        head = bytes(frame[_NUMBERS.size : end])
        layout = self._layouts.get(head)
        if layout is None:
            reader = _Reader(frame, _HEAD_SIZE)
            robot, fingerprint, text = (reader.text(n) for n in (robot_size, fingerprint_size, text_size))
            places = _places(reader, count, limits)
            layout = _MessageLayout(robot, fingerprint, text, places, head, size)
            if not (text or any(place.jpeg for place in places)):  # they rarely repeat
                self._layouts.keep(head, layout)
        return layout

    def _picture(self, frame: memoryview, place: _Place) -> NDArray[np.uint8]:
        if self._codec is None:
            raise WireError(f"picture {place.name!r}: JPEG, which this side does not support")
        height, width, channels = place.shape
        try:
            picture = self._codec.decode(frame[place.offset : place.offset + place.nbytes], (height, width, channels))
        except WireError as error:
            raise WireError(f"picture {place.name!r}: {error}") from None
        except Exception as error:  # contained: a decoder may raise anything for bytes from the network
            raise WireError(f"picture {place.name!r}: {type(error).__name__}: {error}") from error
        if picture.shape != place.shape or picture.dtype != _BYTE:
            raise WireError(
                f"picture {place.name!r} is {picture.dtype} {picture.shape}, not {place.shape} as announced"
            )
        picture.flags.writeable = False
        return picture


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


def _places(reader: _Reader, count: int, limits: WireLimits) -> Sequence[_Place]:
    table = []
    for _ in range(count):
        offset, nbytes, code, ndim, name_size = _ENTRY.unpack(reader.take(_ENTRY.size))
        if ndim > limits.ndim or not 0 < name_size <= limits.name:
            raise WireError(f"a tensor of {ndim} dimensions with a name of {name_size} bytes: over the limits")
        shape = struct.unpack(f"<{ndim}I", reader.take(4 * ndim))
        table.append((reader.text(name_size), code, shape, offset, nbytes))
    places: dict[str, _Place] = {}
    cursor, decoded = reader.at, 0
    for name, code, shape, offset, nbytes in table:
        if name in places:
            raise WireError(f"two tensors named {name!r}")
        if offset != _aligned(cursor) or offset + nbytes > len(reader.frame):
            raise WireError(f"tensor {name!r}: {nbytes} bytes at the wrong offset {offset}")
        cursor = offset + nbytes
        if code != _JPEG and not 0 < code <= len(_DTYPES):
            raise WireError(f"tensor {name!r} of the unknown dtype {code}")
        dtype = _BYTE if code == _JPEG else _DTYPES[code - 1]
        # A dimension of zero must not hide the others from the limit.
        claimed = math.prod(max(1, n) for n in shape) * dtype.itemsize
        if code == _JPEG:
            if len(shape) != 3 or shape[2] not in (1, 3) or 0 in shape:
                raise WireError(f"picture {name!r} of shape {shape}, expected (height, width, 3 or 1)")
            decoded += claimed
            if decoded > limits.size:
                raise WireError(f"picture {name!r} of shape {shape} is larger than {limits.size} bytes")
        elif claimed > limits.size or math.prod(shape) * dtype.itemsize != nbytes:
            raise WireError(f"tensor {name!r} of shape {shape} and dtype {dtype} in {nbytes} bytes")
        places[name] = _Place(name, dtype, shape, offset, nbytes, code == _JPEG)
    if cursor != len(reader.frame):
        raise WireError(f"{len(reader.frame) - cursor} bytes after the last tensor")
    return list(places.values())
