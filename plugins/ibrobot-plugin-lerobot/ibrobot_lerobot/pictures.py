"""Single images as PNG, depth as TIFF: both lossless and readable by LeRobot."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import Any

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature

_PNG_FORMATS = {1: "gray", 3: "rgb24"}
_TIFF_SAMPLES = {np.dtype(np.uint16): 1, np.dtype(np.float32): 3}
"""Element type -> TIFF's number for unsigned integers or IEEE floats."""


class PngEncoder:
    """Encodes images of one size.

    Args:
        height: image height [px].
        width: image width [px].
        channels: 3 for RGB, 1 for grey.
    """

    def __init__(self, height: int, width: int, channels: int) -> None:
        self._format = _PNG_FORMATS[channels]
        codec: Any = av.CodecContext.create("png", "w")
        codec.width, codec.height, codec.pix_fmt = width, height, self._format
        codec.time_base = Fraction(1)
        codec.options = {"compression_level": "1", "pred": "up"}
        self._codec = codec

    def __call__(self, image: NDArray[np.uint8]) -> bytes:
        """Encode `image`, shape (H, W, C), as a PNG file."""
        pixels = image[..., 0] if self._format == "gray" else image
        packets = self._codec.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), self._format))
        return b"".join(bytes(packet) for packet in packets)


_DECODERS = {b"\x89PNG": "png", b"\xff\xd8\xff": "mjpeg"}
"""First bytes of a file -> decoder."""
_TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_KINDS = {1: "B", 3: "H", 4: "I"}
"""TIFF's number for a type of values -> that of `struct`."""


def decode_picture(content: bytes, feature: Feature) -> NDArray[Any]:
    """Decode an image file from a table.

    Args:
        content: a PNG, JPEG or uncompressed TIFF file.
        feature: expected shape (H, W, C) and element type.

    Raises:
        DatasetError: if it cannot be decoded or does not match `feature`.
    """
    codec = next((name for begin, name in _DECODERS.items() if content.startswith(begin)), None)
    try:
        array = _decode_tiff(content, feature) if codec is None else _decode(content, codec, feature)
    except (av.error.FFmpegError, ValueError, struct.error) as error:
        raise DatasetError(f"an image of {len(content)} bytes cannot be decoded: {error}") from error
    array = array.reshape(*array.shape[:2], -1)
    if array.shape != feature.shape:
        raise DatasetError(f"an image has shape {array.shape}, must be {feature.shape}")
    return array


def _decode(content: bytes, codec: str, feature: Feature) -> NDArray[Any]:
    pixels = {"image": {1: "gray", 3: "rgb24"}[feature.shape[2]], "uint16": "gray16le"}
    decoder: Any = av.CodecContext.create(codec, "r")
    frame: Any = next(iter([*decoder.decode(av.Packet(content)), *decoder.decode(None)]), None)
    if frame is None or feature.dtype not in pixels:
        raise ValueError(f"it has no image of {feature.dtype}")
    array: NDArray[Any] = frame.to_ndarray(format=pixels[feature.dtype])
    return array


def _decode_tiff(content: bytes, feature: Feature) -> NDArray[Any]:
    """Decode a TIFF here, because FFmpeg's decoder does not support float32."""
    order = _TIFF_ORDERS.get(content[:4])
    if order is None:
        raise ValueError(f"it begins with {content[:4]!r}, which is neither PNG, JPEG nor TIFF")
    (begin,) = struct.unpack_from(f"{order}I", content, 4)
    (count,) = struct.unpack_from(f"{order}H", content, begin)
    tags: dict[int, tuple[int, ...]] = {259: (1,)}
    for at in range(begin + 2, begin + 2 + 12 * count, 12):
        tag, kind, number = struct.unpack_from(f"{order}HHI", content, at)
        if kind not in _TIFF_KINDS:
            continue
        layout = f"{order}{number}{_TIFF_KINDS[kind]}"
        place = at + 8 if struct.calcsize(layout) <= 4 else struct.unpack_from(f"{order}I", content, at + 8)[0]
        tags[tag] = struct.unpack_from(layout, content, place)
    if tags[259] != (1,) or not tags.keys() >= {256, 257, 273, 279}:
        raise ValueError("it is compressed, or not in strips")
    strips = b"".join(content[o : o + n] for o, n in zip(tags[273], tags[279], strict=True))
    dtype = np.dtype(feature.dtype)
    pixels = np.frombuffer(strips, dtype.newbyteorder("<" if order == "<" else ">")).astype(dtype)
    return pixels.reshape(tags[257][0], tags[256][0])


def tiff(depth: NDArray[Any]) -> bytes:
    """Encode a depth image, uint16 or float32, shape (H, W, 1), as TIFF: one uncompressed strip, little-endian."""
    height, width = depth.shape[:2]
    pixels = np.ascontiguousarray(depth[..., 0]).astype(depth.dtype.newbyteorder("<"), copy=False).tobytes()
    entries = (
        (256, 4, width), (257, 4, height), (258, 3, 8 * depth.dtype.itemsize), (259, 3, 1), (262, 3, 1),
        (273, 4, 8), (277, 3, 1), (278, 4, height), (279, 4, len(pixels)), (339, 3, _TIFF_SAMPLES[depth.dtype]),
    )  # fmt: skip
    directory = struct.pack("<H", len(entries))
    directory += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    padding = b"\0" * (len(pixels) % 2)
    begin = 8 + len(pixels) + len(padding)
    return b"II*\0" + struct.pack("<I", begin) + pixels + padding + directory + b"\0\0\0\0"
