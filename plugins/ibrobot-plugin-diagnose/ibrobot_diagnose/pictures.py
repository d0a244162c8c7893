"""Comparison of pictures: size of a thumbnail, brightness, sharpness and colours.

`alignment` compares where things are, `looks` the light, area by area. This module
also writes and reads the PNG files of cards and reports.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray
from PIL import Image

_MOST_PIXELS = 1 << 24
"""Largest picture that is read."""

type Grey = NDArray[np.float32]

SMALL = (24, 32)
"""Height and width of the thumbnails that are compared [pixels]."""
WIDTH = 160
"""Width of the pictures that are kept [pixels]; between this and twice as much."""
_SHARP_WIDTH = 320
_WEIGHTS = np.array([0.299, 0.587, 0.114], np.float32)


@attrs.frozen(eq=False)
class Picture:
    """What is known of a picture without its pixels."""

    digest: bytes
    """Equal for equal pictures."""
    small: NDArray[np.uint8]
    """The thumbnail, shape (24, 32, 3)."""
    brightness: float
    """Mean of the grey values, 0 to 255."""
    contrast: float
    """Standard deviation of the grey values."""
    sharpness: float
    """Deviation of the Laplacian in relation to that of the grey values; falls if the picture is blurred."""
    clipped: float
    """Share of the pixels that are white."""


@attrs.frozen(eq=False)
class Shown:
    """A picture of a finding."""

    title: str
    picture: NDArray[np.uint8]
    """Shape (H, W, 3)."""


def grey(picture: NDArray[np.generic]) -> Grey:
    """Grey values from 0 to 255, shape (H, W)."""
    result: Grey = picture.astype(np.float32) @ _WEIGHTS
    return result


def shrink(picture: NDArray[np.uint8], width: int = WIDTH) -> NDArray[np.uint8]:
    """The picture, shape (H, W, 3), divided by a whole number so that it is at least `width` wide."""
    factor = max(1, picture.shape[1] // width)
    if factor == 1:
        return picture.copy()
    height, wide = (size // factor * factor for size in picture.shape[:2])
    blocks = picture[:height, :wide].reshape(height // factor, factor, wide // factor, factor, 3)
    return blocks.mean((1, 3), dtype=np.float32).round().astype(np.uint8)


def resized(picture: NDArray[np.generic], size: tuple[int, int]) -> NDArray[np.float32]:
    """The picture by areas, shape (H, W, …), at most as large as it is; otherwise by the nearest pixels."""
    values = picture.astype(np.float32)
    for axis, wanted in enumerate(size):
        has = values.shape[axis]
        edges = np.arange(wanted) * has // wanted
        if has < wanted:
            values = np.take(values, edges, axis)
            continue
        counts = np.diff(np.append(edges, has)).astype(np.float32)
        shape = [1] * values.ndim
        shape[axis] = wanted
        values = (np.add.reduceat(values, edges, axis) / counts.reshape(shape)).astype(np.float32)
    return values


def reddened(picture: NDArray[np.uint8], weights: NDArray[np.floating]) -> NDArray[np.uint8]:
    """The picture in grey, with red where the weights, shape (h, w), exceed the smallest one; none if all are equal."""
    height, width = picture.shape[:2]
    scaled = (255 * (weights - weights.min()) / max(float(weights.max()), 1e-12)).astype(np.uint8)
    mask = np.asarray(Image.fromarray(scaled).resize((width, height), Image.Resampling.BILINEAR), np.float32) / 255
    shown = np.repeat(grey(picture)[..., None], 3, axis=2) * (1 - 0.6 * mask[..., None])
    shown[..., 0] += 0.6 * 255 * mask
    return np.clip(shown, 0, 255).astype(np.uint8)


def small_of(picture: NDArray[np.uint8], digest: bytes = b"") -> Picture:
    """What is known of a picture, shape (H, W, 3)."""
    middle = shrink(picture, _SHARP_WIDTH)
    values = grey(middle)
    contrast = float(values.std())
    inner = values[1:-1, 1:-1]
    laplacian = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:] - 4 * inner
    sharpness = float(laplacian.std()) / max(contrast, 1.0) if inner.size else 0.0
    small = resized(middle, SMALL).round().astype(np.uint8)
    red, green, blue = np.moveaxis(middle, 2, 0)
    clipped = float(((red >= 250) & (green >= 250) & (blue >= 250)).mean())
    return Picture(digest, small, float(values.mean()), contrast, sharpness, clipped)


def descriptors(small: NDArray[np.generic]) -> NDArray[np.float32]:
    """Vectors to compare thumbnails, shape (N, 576), whatever their brightness and contrast.

    Each has the grey values of 12 x 16 areas, and twice the differences of red and blue from green of 12 x 16 areas,
    all in units of the grey values' deviation, divided so that the length of a vector is about 1.
    """
    values = small.astype(np.float32).reshape(len(small), 12, 2, 16, 2, 3).mean((2, 4))
    level = values @ _WEIGHTS
    centred = level - level.mean((1, 2), keepdims=True)
    scale = np.maximum(centred.std((1, 2), keepdims=True), 4.0)
    red, blue = (values[..., channel] - values[..., 1] for channel in (0, 2))
    parts = [centred / scale, 0.5 * red / scale, 0.5 * blue / scale]
    result: NDArray[np.float32] = np.stack(parts, axis=1).reshape(len(small), -1).astype(np.float32)
    return result / np.float32(np.sqrt(12 * 16))


def nearest(ones: NDArray[np.float32], others: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Distance to the nearest of the others, and its index, for each vector."""
    squares = (ones**2).sum(1)[:, None] + (others**2).sum(1)[None] - 2 * ones @ others.T
    index = squares.argmin(axis=1)
    return np.sqrt(np.maximum(squares[np.arange(len(ones)), index], 0.0)), index


def background(pictures: Sequence[NDArray[np.uint8]]) -> tuple[Grey, Grey]:
    """Median of pictures of one size in grey, and how far they deviate from it: what moves deviates much."""
    values = np.stack([grey(each) for each in pictures])
    middle = np.median(values, axis=0).astype(np.float32)
    return middle, np.median(np.abs(values - middle), axis=0).astype(np.float32)


def png(picture: NDArray[np.uint8]) -> bytes:
    """A PNG file of a picture in colours, shape (H, W, 3)."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def read_png(data: bytes) -> NDArray[np.uint8]:
    """The picture of a file of `png`.

    Raises:
        ValueError: if it is another file, or damaged.
    """
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
            if picture.mode != "RGB" or picture.width * picture.height > _MOST_PIXELS:
                raise ValueError(f"a picture is {picture.mode} of {picture.width} x {picture.height} pixels")
            return np.array(picture, np.uint8)
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:  # as Pillow reports damage
        raise ValueError(f"a picture cannot be read: {error}") from None
