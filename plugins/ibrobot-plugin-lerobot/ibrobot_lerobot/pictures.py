"""Single pictures as PNG, depth as TIFF: both without loss, and as LeRobot reads them."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

_PNG_FORMATS = {1: "gray", 3: "rgb24"}
_TIFF_SAMPLES = {np.dtype(np.uint16): 1, np.dtype(np.float32): 3}
"""Element type -> TIFF's number for unsigned integers or IEEE floats."""


class PngEncoder:
    """Encodes pictures of one size.

    Args:
        height: of every picture [px].
        width: likewise.
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
        """A file of `image`, shape (H, W, C)."""
        pixels = image[..., 0] if self._format == "gray" else image
        packets = self._codec.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), self._format))
        return b"".join(bytes(packet) for packet in packets)


def tiff(depth: NDArray[Any]) -> bytes:
    """A file of a depth picture, uint16 or float32, shape (H, W, 1): one uncompressed strip, little-endian."""
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
