"""Pictures to and from JPEG."""

from __future__ import annotations

import numpy as np
import simplejpeg  # type: ignore[import-untyped]

from ibrobot_core.errors import RecorderError
from ibrobot_core.messages import CompressedImage, Image

_SPACES = {"rgb8": ("RGB", 3), "bgr8": ("BGR", 3), "mono8": ("GRAY", 1)}
"""Encoding -> colour space and number of channels."""


def fits_jpeg(image: Image) -> bool:
    """Whether a picture's encoding can be kept as JPEG."""
    return image.encoding in _SPACES


def to_jpeg(image: Image, quality: int) -> CompressedImage:
    """The picture as JPEG, with its encoding in `format` as image_transport writes it.

    Raises:
        RecorderError: for an encoding that JPEG has not, or data that is no such picture.
    """
    if image.encoding not in _SPACES:
        raise RecorderError(f"a {image.encoding} picture cannot become JPEG, only {', '.join(_SPACES)} can")
    space, channels = _SPACES[image.encoding]
    try:
        rows = image.data.reshape(image.height, image.step)[:, : image.width * channels]
        pixels = np.ascontiguousarray(rows).reshape(image.height, image.width, channels)
        data = simplejpeg.encode_jpeg(pixels, quality, space, "Gray" if channels == 1 else "420", fastdct=False)
    except ValueError as error:
        raise RecorderError(f"{image.width}x{image.height} {image.encoding} picture: {error}") from error
    kept = "mono8" if channels == 1 else "bgr8"
    return CompressedImage(image.header, f"{image.encoding}; jpeg compressed {kept}", np.frombuffer(data, np.uint8))


def is_jpeg(image: CompressedImage) -> bool:
    """Whether the picture is a JPEG, by its first bytes."""
    return image.data[:3].tobytes() == b"\xff\xd8\xff"


def from_jpeg(image: CompressedImage) -> Image:
    """The picture of a JPEG, in the encoding that its `format` names; else mono8 or rgb8, as the JPEG is.

    Raises:
        RecorderError: for a damaged JPEG.
    """
    data = image.data.tobytes()
    try:
        height, width, stored, _ = simplejpeg.decode_jpeg_header(data)
        encoding = image.format.partition(";")[0].strip()
        if encoding not in _SPACES:
            encoding = "mono8" if stored == "Gray" else "rgb8"
        space, channels = _SPACES[encoding]
        pixels = simplejpeg.decode_jpeg(data, space)
    except ValueError as error:
        raise RecorderError(f"JPEG picture of {len(data)} bytes: {error}") from error
    return Image(image.header, height, width, encoding, width * channels, pixels.ravel())
