"""Comparison of pictures: size of a thumbnail, brightness, sharpness, colours, and how far a camera has moved.

No other module compares pictures. It also writes and reads the PNG files of cards and reports.
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
_LEVELS = (4, 2, 1)
_STEPS = 12


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
    """The picture in grey, with red where the weights, shape (h, w), are large."""
    height, width = picture.shape[:2]
    scaled = (255 * weights / max(float(weights.max()), 1e-12)).astype(np.uint8)
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
    clipped = float((middle.min(axis=2) >= 250).mean())
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


@attrs.frozen
class Shift:
    """How a picture has moved against another."""

    pixels: float
    """Median displacement over the picture, of 640 pixels' width."""
    angle: float
    """Rotation in the picture's plane [rad]."""
    scale: float
    before: float
    """Correlation of the pictures as they are, -1 to 1."""
    after: float
    """Correlation after they are aligned."""


def shift_of(reference: Grey, picture: Grey, weight: Grey | None = None) -> Shift | None:
    """How far a picture has moved against a reference of the same size; None if it is uncertain.

    A similarity (shift, turn and scale) is fitted to the gradients, from coarse to fine. Gradients do not depend on
    brightness. It is uncertain if the reference has too little texture, or nothing fits.

    Args:
        reference: grey values, shape (H, W).
        picture: likewise.
        weight: of each pixel, e.g. 0 where something moves.
    """
    if reference.shape != picture.shape or min(reference.shape) < 32:
        return None
    weight = np.ones_like(reference) if weight is None else weight
    p = np.zeros(4, np.float64)  # shift x, shift y, scale - 1, turn; in pixels of the whole picture
    first = _textures(reference, 1), _textures(picture, 1)
    if first[0].std() < 1e-3 or float((np.hypot(*np.gradient(reference)) > 6).mean()) < 0.01:
        return None
    before = _correlation(*first, weight)
    starts = [p, *_coarse(_textures(reference, 4), _textures(picture, 4))]
    best: tuple[float, NDArray[np.float64]] = (-1.0, p)
    for start in starts:
        fitted = start
        for level in _LEVELS:
            fitted = _refine(
                _textures(reference, level), _textures(picture, level), _halved(weight, level), fitted, level
            )
        moved, inside = _warp(first[1], fitted, 1)
        quality = _correlation(first[0], moved, weight * inside) if inside.mean() > 0.3 else -1.0
        best = max(best, (quality, fitted), key=lambda each: each[0])
    after, p = best
    height, width = reference.shape
    rows, columns = np.mgrid[0 : height : max(1, height // 8), 0 : width : max(1, width // 8)].astype(np.float64)
    x, y = columns - width / 2, rows - height / 2
    moved_x, moved_y = p[0] + p[2] * x - p[3] * y, p[1] + p[3] * x + p[2] * y
    pixels = float(np.median(np.hypot(moved_x, moved_y))) * 640 / width
    return Shift(pixels, float(np.arctan2(p[3], 1 + p[2])), float(np.hypot(1 + p[2], p[3])), before, after)


def _halved(values: Grey, factor: int) -> Grey:
    if factor == 1:
        return values
    height, width = (size // factor * factor for size in values.shape)
    blocks = values[:height, :width].reshape(height // factor, factor, width // factor, factor)
    result: Grey = blocks.mean((1, 3), dtype=np.float32)
    return result


def _textures(values: Grey, factor: int) -> Grey:
    """The picture without its slow changes of brightness, divided by its local contrast."""
    small = _halved(values, factor)
    flat = small - _blurred(small, 4)
    return _blurred((flat / (np.sqrt(_blurred(flat**2, 4)) + 4.0)).astype(np.float32), 1)


def _blurred(values: Grey, radius: int) -> Grey:
    """Mean of squares around each pixel."""
    for axis in (0, 1):
        padded = np.pad(values, [(radius + 1, radius) if i == axis else (0, 0) for i in (0, 1)], mode="edge")
        sums = np.cumsum(padded, axis=axis, dtype=np.float64)
        high = np.take(sums, range(2 * radius + 1, sums.shape[axis]), axis)
        low = np.take(sums, range(sums.shape[axis] - 2 * radius - 1), axis)
        values = ((high - low) / (2 * radius + 1)).astype(np.float32)
    return values


def _coarse(reference: Grey, picture: Grey) -> list[NDArray[np.float64]]:
    """Shifts for which the pictures correlate best, by the phase."""
    window = np.outer(np.hanning(reference.shape[0]), np.hanning(reference.shape[1]))
    product = np.fft.rfft2(picture * window) * np.conj(np.fft.rfft2(reference * window))
    surface = np.fft.irfft2(product / (np.abs(product) + 1e-6), reference.shape)
    starts = []
    for flat in np.argsort(surface, axis=None)[::-1][:2]:
        y, x = (int(each) for each in np.unravel_index(flat, surface.shape))
        y, x = (at - size if at > size // 2 else at for at, size in ((y, surface.shape[0]), (x, surface.shape[1])))
        starts.append(np.array([x * 4.0, y * 4.0, 0.0, 0.0]))
    return starts


def _warp(picture: Grey, p: NDArray[np.float64], factor: int) -> tuple[Grey, Grey]:
    """The picture at the places to which the similarity moves each pixel, and where these lie inside."""
    height, width = picture.shape
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = columns - width / 2, rows - height / 2
    at_x = columns + p[0] / factor + p[2] * x - p[3] * y
    at_y = rows + p[1] / factor + p[3] * x + p[2] * y
    inside = (at_x >= 0) & (at_x <= width - 1) & (at_y >= 0) & (at_y <= height - 1)
    x0, y0 = np.clip(at_x.astype(int), 0, width - 2), np.clip(at_y.astype(int), 0, height - 2)
    fx, fy = np.clip(at_x - x0, 0, 1), np.clip(at_y - y0, 0, 1)
    upper = picture[y0, x0] * (1 - fx) + picture[y0, x0 + 1] * fx
    lower = picture[y0 + 1, x0] * (1 - fx) + picture[y0 + 1, x0 + 1] * fx
    return (upper * (1 - fy) + lower * fy).astype(np.float32), inside.astype(np.float32)


def _refine(reference: Grey, picture: Grey, weight: Grey, p: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Improve a similarity by Gauss-Newton steps; large residuals count less."""
    height, width = reference.shape
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = (columns - width / 2).ravel(), (rows - height / 2).ravel()
    for _ in range(_STEPS):
        moved, inside = _warp(picture, p, factor)
        down, across = np.gradient(moved)
        gx, gy = across.ravel(), down.ravel()
        residual = (moved - reference).ravel()
        scale = 1.4826 * np.median(np.abs(residual)) + 1e-6
        robust = (weight * inside).ravel() / (1 + (residual / (2 * scale)) ** 2)
        jacobian = np.stack([gx / factor, gy / factor, gx * x + gy * y, gy * x - gx * y], axis=1)
        weighted = jacobian * robust[:, None]
        normal = jacobian.T @ weighted + np.diag([1e-6, 1e-6, 1e-3, 1e-3])
        step = np.linalg.solve(normal, weighted.T @ residual)
        p = p - step
        if abs(p[2]) > 0.5 or abs(p[3]) > 0.7 or np.abs(p[:2]).max() > max(height, width) * factor:
            return np.zeros(4)
        if np.abs(step[:2]).max() < 0.01 * factor and np.abs(step[2:]).max() < 1e-4:
            break
    return p


def _correlation(one: Grey, other: Grey, weight: Grey) -> float:
    total = float(weight.sum()) + 1e-9
    a, b = (each - float((each * weight).sum()) / total for each in (one, other))
    norm = float(np.sqrt((weight * a * a).sum() * (weight * b * b).sum()))
    return float((weight * a * b).sum()) / norm if norm > 0 else 0.0


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
