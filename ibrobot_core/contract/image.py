"""Images: conversion of messages to numpy arrays, for the encodings of sensor_msgs, and resizing."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import ContractError
from ibrobot_core.messages import CompressedImage, Image
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.schema import ImageSpec

ENCODINGS: dict[str, tuple[type[np.generic], int]] = {
    "rgb8": (np.uint8, 3),
    "bgr8": (np.uint8, 3),
    "rgba8": (np.uint8, 4),
    "bgra8": (np.uint8, 4),
    "mono8": (np.uint8, 1),
    "mono16": (np.uint16, 1),
    "16UC1": (np.uint16, 1),
    "32FC1": (np.float32, 1),
}
"""Encoding -> element type and channels."""

_LUMA = np.array([299, 587, 114], dtype=np.uint32)


def pixels(message: Image) -> NDArray[np.generic]:
    """The pixels of a message in its encoding, shape (H, W, C), in native byte order; a view if possible.

    Raises:
        ContractError: for an unknown encoding, or too few bytes for the size.
    """
    if message.encoding not in ENCODINGS:
        raise ContractError(f"image encoding {message.encoding!r} is not one of: {', '.join(ENCODINGS)}")
    element, channels = ENCODINGS[message.encoding]
    dtype = np.dtype(element).newbyteorder(">" if message.is_bigendian else "<")
    used = message.width * channels * dtype.itemsize
    if not used or not message.height or message.step < used or message.data.size != message.height * message.step:
        raise ContractError(
            f"an image of {message.height}x{message.width} {message.encoding} needs rows of at least {used} bytes, and "
            f"rows x step bytes in all, not zero; this one has a step of {message.step} and {message.data.size} bytes"
        )
    rows = message.data.reshape(message.height, message.step)[:, :used]
    typed = rows.view(dtype).reshape(message.height, message.width, channels)
    return typed.astype(element, copy=False)


def decode_image(
    message: Image | CompressedImage, spec: ImageSpec, rectify: Callable[[Any], Any] | None = None
) -> NDArray[np.generic]:
    """Decode an image as the contract specifies: rectify and resize it, then convert its encoding.

    Returns:
        Shape (H, W, C): uint8 for rgb8, bgr8 and mono8; uint16 for 16UC1 [mm]; float32 for 32FC1 [m]. Depth is 0 for
        pixels without a reading, which REP 118 marks in 32FC1 by NaN, -inf (too near) and inf (too far).

    Raises:
        ContractError: for a malformed message, or an encoding that cannot be converted.
    """
    if isinstance(message, CompressedImage):
        message = installed_plugins().decode(message)
    array = pixels(message) if rectify is None else rectify(pixels(message))
    if spec.resize is not None and spec.resize != array.shape[:2]:
        array = resize(array, *spec.resize)
    return np.ascontiguousarray(_convert(array, message.encoding, spec.encoding))


def resize(array: NDArray[np.generic], height: int, width: int) -> NDArray[np.generic]:
    """Resize an image, with the same bits on every machine.

    Colours (uint8) are averaged over the area of each new pixel, in exact integer arithmetic, half rounded up; when
    enlarging, this repeats pixels. Depth (uint16, float32) is taken from the pixel under the new pixel's centre, since
    a mean over an edge, or with a pixel without a reading, would create a false surface.

    Args:
        array: shape (H, W, C).
        height: new H, at least 1.
        width: new W, at least 1.
    """
    if array.dtype != np.uint8:
        return np.ascontiguousarray(array[_centres(array.shape[0], height)[:, None], _centres(array.shape[1], width)])
    # Rows first: they are contiguous, and reduce the work for the columns.
    rows = _Cover.of(array.shape[0], height)
    columns = _Cover.of(array.shape[1], width)
    total = rows.units * columns.units
    narrow = rows.sums(array.reshape(array.shape[0], -1), 0, 255 * rows.units)
    summed = columns.sums(narrow.reshape(height, array.shape[1], -1), 1, 255 * total + total // 2)
    summed += summed.dtype.type(total // 2)
    summed //= summed.dtype.type(total)
    return summed.astype(np.uint8)


@attrs.frozen
class _Cover:
    """Coverage of old pixels by new ones along an axis, in whole units: `units` per new and `unit` per old pixel."""

    new: int
    units: int
    unit: int

    @classmethod
    def of(cls, old: int, new: int) -> _Cover:
        divisor = math.gcd(old, new)
        return cls(new, old // divisor, new // divisor)

    def sums(self, array: NDArray[Any], axis: int, most: int) -> NDArray[Any]:
        """Sums along `axis` of old pixels weighted by their covered units, in the smallest type that holds `most`."""
        kind: Any = next(t for t in (np.uint16, np.uint32, np.uint64) if most <= np.iinfo(t).max)
        result: NDArray[Any] = np.zeros([self.new if i == axis else n for i, n in enumerate(array.shape)], dtype=kind)
        if self.unit == 1:  # whole pixels: add neighbours without weights
            for k in range(self.units):
                result += array[(slice(None),) * axis + (slice(k, None, self.units),)]
            return result
        term = np.empty_like(result)  # new pages for every product would cost more than the products
        begin = np.arange(self.new, dtype=np.int64) * self.units
        for tap in range(-(-self.units // self.unit) + 1):
            pixel = begin // self.unit + tap
            shared = np.minimum(begin + self.units, (pixel + 1) * self.unit) - np.maximum(begin, pixel * self.unit)
            weight = np.clip(shared, 0, None).astype(kind).reshape([-1 if i == axis else 1 for i in range(array.ndim)])
            # Beyond the end the weight is zero.
            result += np.multiply(np.take(array, pixel, axis, mode="clip"), weight, out=term)
        return result


def _centres(old: int, new: int) -> NDArray[np.intp]:
    """The old pixel under the centre of each new pixel, shape (new,)."""
    return ((2 * np.arange(new) + 1) * old // (2 * new)).astype(np.intp)


def _convert(array: NDArray[Any], given: str, wanted: str) -> NDArray[Any]:
    """Convert pixels from encoding `given` to `wanted`: reorder colours, drop alpha, use BT.601 luma for grey."""
    if given == wanted == "32FC1":
        return np.where(np.isfinite(array), array, np.float32(0))
    if given == wanted or (given, wanted) == ("mono16", "16UC1"):
        return array
    if array.dtype != np.uint8 or wanted not in ("rgb8", "bgr8", "mono8"):
        raise ContractError(f"an image encoded as {given} cannot be converted to {wanted}; see `image.encoding`")
    if given == "mono8":
        return np.repeat(array, 3, axis=2)
    rgb = array[..., 2::-1] if given.startswith("bgr") else array[..., :3]
    if wanted == "mono8":
        return ((rgb @ _LUMA + np.uint32(500)) // np.uint32(1000)).astype(np.uint8)[..., None]
    return rgb if wanted == "rgb8" else rgb[..., ::-1]
