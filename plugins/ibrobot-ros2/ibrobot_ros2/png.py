"""PNG pictures in bags: `CompressedImage` to `Image`, also with the header of `compressedDepth` before them."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from ibrobot_core.api import CompressedImage, ContractError, Image

_BEGINS = b"\x89PNG\r\n\x1a\n"
_KIND = slice(24, 26)
"""Offsets of a PNG's bits per sample and colour type."""
_ENCODINGS = {b"\x08\x00": "mono8", b"\x08\x02": "rgb8", b"\x08\x06": "rgba8", b"\x10\x00": "16UC1"}
_COLOURS = {0: "grey", 2: "RGB", 3: "a palette", 4: "grey with alpha", 6: "RGBA"}
_CHUNK = struct.Struct(">I4s")
_CRC = struct.Struct(">I")
_DEPTH = "compressedDepth"
_DEPTH_HEADER = struct.Struct("<iff")
"""Header of image_transport: a number for the format, and A and B of the quantisation."""


def is_png(image: CompressedImage) -> bool:
    """Whether the picture is a PNG, by its first bytes, or by those after the header of `compressedDepth`."""
    return image.data[_begin(image) :][: len(_BEGINS)].tobytes() == _BEGINS


def from_png(image: CompressedImage) -> Image:
    """The picture of a PNG, exactly: mono8, rgb8 or rgba8 as the PNG is, 16UC1 for 16 bits of grey.

    `compressedDepth` of 32FC1 is depth by quantised inverse depth, depth = A / (value - B) [m]; where the value is 0
    there was no reading, and the depth is 0, as in 16UC1.

    Raises:
        ContractError: for a damaged PNG, or one of another kind.
    """
    data = image.data.tobytes()
    file = data[_begin(image) :]
    encoding = _ENCODINGS.get(file[_KIND])
    if encoding is None:
        raise ContractError(f"a PNG {_kind(file)} cannot be read, only 8-bit grey, RGB and RGBA, and 16-bit grey")
    pixels = _decode(file, encoding)
    if _begin(image) and image.format.startswith("32FC1"):
        encoding, pixels = "32FC1", _depth(pixels, data)
    height, width = pixels.shape[:2]
    little = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<")).view(np.uint8)
    return Image(image.header, height, width, encoding, little.size // height, little.ravel())


def _begin(image: CompressedImage) -> int:
    """Offset of the PNG."""
    return _DEPTH_HEADER.size if _DEPTH in image.format else 0


def _kind(file: bytes) -> str:
    """What a PNG is, in words."""
    kind = file[_KIND]
    return f"of {kind[0]} bits and {_COLOURS.get(kind[1], 'unknown colours')}" if len(kind) == 2 else "without a header"


def _decode(file: bytes, encoding: str) -> NDArray[np.generic]:
    """The pixels, shape (H, W) or (H, W, C)."""
    try:
        _check(memoryview(file))
        with Pillow.open(BytesIO(file), formats=["PNG"]) as picture:
            pixels: NDArray[np.generic] = np.asarray(picture)
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, Pillow.DecompressionBombError) as error:
        raise ContractError(f"PNG picture of {len(file)} bytes: {error}") from error
    return pixels.astype(np.uint16 if encoding == "16UC1" else np.uint8, copy=False)


def _check(file: memoryview) -> None:
    """Check that a PNG is whole and its checksums are right, which the library does not do for pixels."""
    at = len(_BEGINS)
    while at + _CHUNK.size <= len(file):
        length, kind = _CHUNK.unpack_from(file, at)
        end = at + _CHUNK.size + length
        if end + _CRC.size > len(file):
            break
        if zlib.crc32(file[at + len(kind) : end]) != _CRC.unpack_from(file, end)[0]:
            raise ValueError(f"the checksum of {kind!r} at byte {at} is wrong")
        if kind == b"IEND":
            return
        at = end + _CRC.size
    raise EOFError("it ends early")


def _depth(values: NDArray[np.generic], data: bytes) -> NDArray[np.float32]:
    """Depth of quantised inverse depth [m], shape (H, W)."""
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    known = values != 0
    inverse = np.where(known, values.astype(np.float32) - np.float32(b), np.float32(1))
    if not (np.isfinite([a, b]).all() and a > 0 and (inverse > 0).all()):
        raise ContractError(f"{_DEPTH} picture: its header is damaged: it is quantised by A = {a:g}, B = {b:g}")
    return np.where(known, np.float32(a) / inverse, np.float32(0))
