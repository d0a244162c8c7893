"""How far a camera has moved, from two of its pictures."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.pictures import Grey

_LEVELS = (4, 2, 1)
_STEPS = 12


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
        places = _places(reference.shape, fitted, 1)
        weights = weight * places.inside
        quality = _correlation(first[0], places.of(first[1]), weights) if places.inside.mean() > 0.3 else -1.0
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
        sums = np.cumsum(padded, axis=axis, dtype=np.float64).swapaxes(0, axis)
        means = (sums[2 * radius + 1 :] - sums[: -2 * radius - 1]) / (2 * radius + 1)
        values = means.swapaxes(0, axis).astype(np.float32)
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


@attrs.frozen(eq=False)
class _Places:
    """Where a similarity moves each pixel of a picture."""

    first: NDArray[np.intp]
    """Index of the pixel above and to the left, shape (H, W)."""
    right: Grey
    """How far it lies from there to the next pixel, 0 to 1, shape (H, W)."""
    down: Grey
    inside: NDArray[np.bool_]
    """Which places lie in the picture, shape (H, W)."""

    def of(self, picture: Grey) -> Grey:
        """The picture at these places, shape (H, W)."""
        values, width = picture.ravel(), picture.shape[1]
        here, below = values.take(self.first), values.take(self.first + width)
        upper = here + (values.take(self.first + 1) - here) * self.right
        lower = below + (values.take(self.first + width + 1) - below) * self.right
        moved: Grey = upper + (lower - upper) * self.down
        return moved


def _places(shape: tuple[int, ...], p: NDArray[np.float64], factor: int) -> _Places:
    height, width = shape
    columns, rows = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    x, y = columns - width / 2, rows - height / 2
    at_x = (columns + p[0] / factor + p[2] * x) - p[3] * y
    at_y = (rows + p[1] / factor + p[2] * y) + p[3] * x
    inside = (at_x >= 0) & (at_x <= width - 1) & (at_y >= 0) & (at_y <= height - 1)
    at_x, at_y = np.clip(at_x, 0, width - 1), np.clip(at_y, 0, height - 1)
    x0, y0 = np.minimum(at_x.astype(np.intp), width - 2), np.minimum(at_y.astype(np.intp), height - 2)
    return _Places(y0 * width + x0, (at_x - x0).astype(np.float32), (at_y - y0).astype(np.float32), inside)


def _inside(places: _Places, shown: Grey | None) -> Grey:
    """How much of each pixel is inside and shown."""
    inside = places.inside.astype(np.float32)
    return inside if shown is None else inside * places.of(shown)


def _refine(
    reference: Grey, picture: Grey, weight: Grey, p: NDArray[np.float64], factor: int, shown: Grey | None = None
) -> NDArray[np.float64]:
    """Improve a similarity by Gauss-Newton steps; large residuals count less.

    `weight` belongs to the pixels of the reference, `shown` to those of the picture.
    """
    height, width = reference.shape
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    x, y = (columns - width / 2).ravel(), (rows - height / 2).ravel()
    for _ in range(_STEPS):
        places = _places(reference.shape, p, factor)
        moved, inside = places.of(picture), _inside(places, shown)
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


_FINE = 320
"""Width of the pictures whose places are compared exactly; between this and twice as much."""
_TURNS = (0.0, 0.09, -0.09, 0.18, -0.18)
"""Turns in the picture's plane from which an alignment begins [rad]."""
AREAS = (9, 12)
"""Areas of a picture, each of which is seen in its place or not."""
_LEAST_SIDE = 48
"""Pixels below which a picture is too small."""
_RICH = 5.0
"""Deviation of the grey values from which an area shows something."""
_ALIKE = 0.6
"""Correlation from which an area shows the same."""
_MOST = 0.7
"""Share of the areas that settles an alignment: what repeats itself in a picture may fit elsewhere, but in fewer."""

type _Fit = tuple[int, float, NDArray[np.float64], NDArray[np.bool_]]
"""How many areas an alignment finds, its quality, the similarity, and which areas these are."""


@attrs.frozen(eq=False)
class Moved:
    """Whether a camera has moved, from a picture and one of before."""

    pixels: float
    """Median displacement of what stands still, for a picture of 640 pixels' width."""
    roll: float
    """Turn in the picture's plane [rad]."""
    rich: int
    """Number of areas of the picture in which something stands still that can be seen."""
    in_place: int
    """Number of these that are where they were."""
    found: int
    """Number of these that are where the alignment says."""
    way: tuple[float, float] = (0.0, 0.0)
    """By how much the middle of the picture has moved to the right and down, for a picture of 640 pixels' width."""

    @property
    def unclear(self) -> str:
        """Why it is uncertain; empty if it is not."""
        if self.rich < 4:
            return f"only {self.rich} of {AREAS[0] * AREAS[1]} areas of the picture show something that stands still"
        # A few areas may fit elsewhere by chance, but hardly in their place.
        least = 3 if self.in_place == self.found else 5
        if self.is_other_view or self.found >= max(least, 0.3 * self.rich):
            return ""
        return f"only {self.found} of {self.rich} areas are found again"

    @property
    def is_other_view(self) -> bool:
        """Whether nearly nothing of the reference can be found; on a table with few things, they may have moved."""
        return self.rich >= 25 and max(self.in_place, self.found) < 0.2 * self.rich


def moved_of(reference: Grey, picture: Grey, weight: Grey, shown: Grey) -> Moved:
    """How far a camera has moved between two pictures of the same size.

    Args:
        reference: grey values, shape (H, W).
        picture: likewise.
        weight: of each pixel of the reference: 0 where something moves, e.g. the arm.
        shown: of each pixel of the picture, likewise.
    """
    if reference.shape != picture.shape or min(reference.shape) < _LEAST_SIDE:
        return Moved(0.0, 0.0, 0, 0, 0)
    levels = {level: (_textures(reference, level), _textures(picture, level)) for level in _LEVELS}
    rich = rich_areas(reference, weight)
    still = np.zeros(4)

    def fit(p: NDArray[np.float64]) -> _Fit:
        alike = _alike(*levels[1], weight, shown, p, rich)
        return int(alike.sum()), _quality(*levels[1], weight, shown, p), p, alike

    def refined(p: NDArray[np.float64]) -> _Fit:
        for level in _LEVELS[1:]:
            p = _refine(*levels[level], _halved(weight, level), p, level, _halved(shown, level))
        return fit(p)

    fits = [fit(still), refined(still)]
    in_place = fits[0][0]
    if max(each[0] for each in fits) < _MOST * rich.sum():  # else no other alignment finds more
        coarse = []
        seen = [_halved(each, 4) for each in (reference, weight, picture, shown)]
        for begin in (still, *_coarse(seen[0] * seen[1], seen[2] * seen[3])):
            for turn in _TURNS:
                start = begin + np.array([0.0, 0.0, np.cos(turn) - 1, np.sin(turn)])
                fitted = _refine(*levels[4], seen[1], start, 4, seen[3])
                coarse.append((_quality(*levels[4], seen[1], seen[3], fitted, 4), fitted))
        coarse.sort(key=lambda each: -each[0])
        fits += [refined(fitted) for _, fitted in coarse[:2]]
    best = max(fits, key=lambda each: each[:2])
    matches, _, p, alike = best
    # What is found all over the picture tells of all of it, also of a turn about its middle.
    spread = matches >= 8 and alike.any(axis=1).sum() >= 3 and alike.any(axis=0).sum() >= 4
    x, y = _centres(reference.shape, np.ones_like(rich) if spread else alike if matches else rich)
    moved_x, moved_y = p[0] + p[2] * x - p[3] * y, p[1] + p[3] * x + p[2] * y
    pixels = float(np.median(np.hypot(moved_x, moved_y))) * 640 / reference.shape[1] if len(x) else 0.0
    way = float(p[0]) * 640 / reference.shape[1], float(p[1]) * 640 / reference.shape[1]
    return Moved(pixels, float(np.arctan2(p[3], 1 + p[2])), int(rich.sum()), in_place, matches, way)


def _quality(
    reference: Grey, picture: Grey, weight: Grey, shown: Grey, p: NDArray[np.float64], factor: int = 1
) -> float:
    places = _places(reference.shape, p, factor)
    inside = _inside(places, shown)
    return _correlation(reference, places.of(picture), weight * inside) if inside.mean() > 0.3 else -1.0


def areas_of(values: Grey) -> Grey:
    """The picture as areas, shape (rows, columns, pixels)."""
    rows, columns = AREAS
    height, width = values.shape[0] // rows, values.shape[1] // columns
    parts = values[: rows * height, : columns * width].reshape(rows, height, columns, width)
    return parts.transpose(0, 2, 1, 3).reshape(rows, columns, -1)


def in_place_of(reference: Grey, picture: Grey, weight: Grey) -> tuple[int, int]:
    """Number of areas of a part of the reference that show something, and of those that are in their place.

    Args:
        reference: grey values, shape (H, W).
        picture: likewise.
        weight: 1 for the part, else 0.
    """
    rich = rich_areas(reference, weight, 0.25)
    shown, textures = np.ones_like(weight), [_textures(each, 1) for each in (reference, picture)]
    alike = _alike(textures[0], textures[1], weight, shown, np.zeros(4), rich, 0.2)
    return int(rich.sum()), int(alike.sum())


def rich_areas(reference: Grey, weight: Grey, least: float = 0.5) -> NDArray[np.bool_]:
    """The areas that show something, and of which at least a share counts."""
    areas, weights = areas_of(reference), areas_of(weight)
    total = weights.sum(axis=2) + 1e-6
    mean = (areas * weights).sum(axis=2) / total
    deviation = np.sqrt(((areas - mean[..., None]) ** 2 * weights).sum(axis=2) / total)
    result: NDArray[np.bool_] = (weights.mean(axis=2) > least) & (deviation > _RICH)
    return result


def _alike(
    reference: Grey, picture: Grey, weight: Grey, shown: Grey, p: NDArray[np.float64], rich: NDArray[np.bool_],
    least: float = 0.3,
) -> NDArray[np.bool_]:  # fmt: skip
    """The rich areas that show the same once the picture is aligned."""
    places = _places(reference.shape, p, 1)
    moved, weights = places.of(picture), areas_of(weight * _inside(places, shown))
    total = weights.sum(axis=2) + 1e-6
    a, b = (each - ((each * weights).sum(axis=2) / total)[..., None] for each in (areas_of(reference), areas_of(moved)))
    norm = np.sqrt((weights * a * a).sum(axis=2) * (weights * b * b).sum(axis=2)) + 1e-9
    alike = (weights * a * b).sum(axis=2) / norm > _ALIKE
    result: NDArray[np.bool_] = rich & alike & (weights.mean(axis=2) > least)
    return result


def _centres(shape: tuple[int, ...], chosen: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places of areas from the middle of the picture [pixels]."""
    rows, columns = np.nonzero(chosen)
    height, width = shape[0] // AREAS[0], shape[1] // AREAS[1]
    middles = [(each.astype(np.float64) + 0.5) * size for each, size in ((columns, width), (rows, height))]
    return middles[0] - shape[1] / 2, middles[1] - shape[0] / 2
