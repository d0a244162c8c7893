"""JPEG pictures: `CompressedImage` to and from `Image`. One decoder for cameras, running robots and bags."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ibrobot_core.api import CompressedImage, ContractError, Header, Image

BEGINS = b"\xff\xd8\xff"
"""The first bytes of every JPEG."""
_SPACES = {"rgb8": ("RGB", 3), "bgr8": ("BGR", 3), "mono8": ("GRAY", 1)}
"""Encoding -> colour space and number of channels."""
_HARMLESS = "extraneous bytes before marker"
"""libjpeg's warning of padding, which cheap webcams leave in whole pictures."""
_MOST_PIXELS = 1 << 26
"""Limit of the memory that a damaged header can make us allocate."""
_SMALLEST = 8
"""An eighth of the size: every byte is read, and few pixels are made."""


def fits_jpeg(image: Image) -> bool:
    """Whether a picture's encoding can be kept as JPEG."""
    return image.encoding in _SPACES


def to_jpeg(image: Image, quality: int) -> CompressedImage:
    """The image as JPEG, with its encoding in `format` as in image_transport.

    Raises:
        ContractError: for an encoding that JPEG has not, or data that is not such a picture.
    """
    if image.encoding not in _SPACES:
        raise ContractError(f"a {image.encoding} image cannot be encoded as JPEG, only {', '.join(_SPACES)}")
    space, channels = _SPACES[image.encoding]
    try:
        rows = image.data.reshape(image.height, image.step)[:, : image.width * channels]
        pixels = np.ascontiguousarray(rows).reshape(image.height, image.width, channels)
        data = simplejpeg.encode_jpeg(pixels, quality, space, "Gray" if channels == 1 else "420", fastdct=False)
    except ValueError as error:
        raise ContractError(f"{image.width}x{image.height} {image.encoding} picture: {error}") from error
    kept = "mono8" if channels == 1 else "bgr8"
    return CompressedImage(image.header, f"{image.encoding}; jpeg compressed {kept}", np.frombuffer(data, np.uint8))


def is_jpeg(image: CompressedImage) -> bool:
    """Whether the picture is a JPEG, by its first bytes."""
    return image.data[: len(BEGINS)].tobytes() == BEGINS


def from_jpeg(image: CompressedImage) -> Image:
    """The picture of a JPEG, in the encoding that its `format` names; else mono8 or rgb8, as the JPEG is.

    Raises:
        ContractError: for a damaged JPEG.
    """
    data = image.data.tobytes()
    height, width, stored = _header(data)
    encoding = image.format.partition(";")[0].strip()
    if encoding not in _SPACES:
        encoding = "mono8" if stored == "Gray" else "rgb8"
    space, channels = _SPACES[encoding]
    pixels = _decode(data, space)
    return Image(image.header, height, width, encoding, width * channels, pixels.ravel())


def own_jpeg(data: NDArray[np.uint8], header: Header) -> tuple[CompressedImage, tuple[int, int]]:
    """A camera's own JPEG as a message, with height and width [px]. It refuses what `from_jpeg` would refuse.

    Args:
        data: the bytes, shape (N,).
        header: stamp and frame.

    Raises:
        ContractError: for a damaged JPEG.
    """
    file = data.tobytes()
    height, width, _ = _header(file)
    _decode(file, "GRAY", min_height=1, min_width=1, min_factor=_SMALLEST)
    return CompressedImage(header, "jpeg", data), (height, width)


def _header(data: bytes) -> tuple[int, int, str]:
    """Height, width [px] and colour space."""
    height, width, stored, _ = _read(simplejpeg.decode_jpeg_header, data)
    if height * width > _MOST_PIXELS:
        raise ContractError(f"JPEG image of {width}x{height}: at most {_MOST_PIXELS} pixels can be decoded")
    return height, width, stored


def _decode(data: bytes, space: str, **options: Any) -> NDArray[np.uint8]:
    """The pixels, shape (H, W, C)."""
    pixels: NDArray[np.uint8] = _read(simplejpeg.decode_jpeg, data, colorspace=space, **options)
    return pixels


def _read(function: Callable[..., Any], data: bytes, **options: Any) -> Any:
    try:
        try:
            return function(data, **options)
        except ValueError as error:
            if _HARMLESS not in str(error):
                raise
            return function(data, strict=False, **options)
    except (ValueError, KeyError) as error:  # KeyError: of a header without a colour space
        raise ContractError(f"JPEG picture of {len(data)} bytes is damaged: {error}") from error
