"""How two pictures of a scene differ in light, colours and sharpness, area by area, whatever moves in them."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.alignment import AREAS, areas_of, rich_areas
from ibrobot_diagnose.pictures import Grey, grey

_LEAST = 0.5
"""Share of an area that must count."""
_ALIKE = 0.7
"""Correlation from which an area shows the same, in focus or not."""
_FEWEST = 4
"""Areas from which they count: fewer may be a thing that has moved."""
_AROUND = 3
"""How far around an area the table is looked for that an object has left [areas]: objects are smaller."""
_EQUAL, _EQUAL_GREY = 0.1, 3.0
"""Differences up to which colours are equal: a share of them, and grey values."""
_DARK, _WHITE = 12.0, 245.0
"""Grey values between which colours are to be seen."""
_FLIPS = {
    "upside down": (slice(None, None, -1), slice(None, None, -1)),
    "mirrored": (slice(None), slice(None, None, -1)),
}


@attrs.frozen(eq=False)
class Looks:
    """A picture in relation to one of before. Medians over the areas, so that what has moved in some does not count."""

    light: float
    """Brightness; 1 if it is the same."""
    red: float
    """Red in relation to green; 1 if it is the same."""
    blue: float
    sharp: float
    """Contrast of the smallest details in relation to all; falls if the picture is blurred. 1 if it is the same."""
    covered: float
    """Share of the areas with something to see in which there is nothing now, nor what is around them."""
    swapped: float
    """How many times as well the colours fit with red and blue exchanged."""
    flip: str
    """How the picture may be turned over."""
    flipped: float
    """How many times as well it fits if it is turned back."""


def looks_of(reference: NDArray[np.uint8], picture: NDArray[np.uint8], weight: Grey) -> Looks:
    """Compare pictures of the same size.

    Args:
        reference: shape (H, W, 3).
        picture: likewise.
        weight: of each pixel, 0 where something moves; shape (H, W).
    """
    weights = areas_of(weight)
    used = weights.mean(axis=2) > _LEAST
    if not used.any():
        used = np.ones(AREAS, np.bool_)
    then, now = (_means(each, weights) for each in (reference, picture))
    light_then, light_now = (each.mean(axis=2) for each in (then, now))
    light = float(np.median(((light_now + 2.0) / (light_then + 2.0))[used]))
    seen = used & (light_then > _DARK) & (light_now > _DARK) & (light_then < _WHITE) & (light_now < _WHITE)
    ratios = [_colours(each)[seen] for each in (then, now)] if seen.any() else [np.ones((1, 2))] * 2
    red, blue = np.median(ratios[1] / ratios[0], axis=0).tolist()
    plain, other = (float(np.abs(np.log(each / ratios[0])).mean()) for each in (ratios[1], ratios[1][:, ::-1]))
    one, two = grey(reference), grey(picture)
    rich = rich_areas(one, weight) & used
    sharp, covered = 1.0, 0.0
    if rich.any():
        both = rich & (_correlation(one, two, weights) > _ALIKE)  # what has moved says nothing of the focus
        if both.sum() >= _FEWEST:
            # In relation to the contrast of the area, which a lamp changes where it lights only a part of it.
            sharpness = [
                _deviation(_details(each), weights)[both] / np.maximum(_deviation(each, weights)[both], 1e-3)
                for each in (one, two)
            ]
            sharp = float(np.median(sharpness[1] / np.maximum(sharpness[0], 1e-3)))
        contrasts = [_deviation(each, weights) for each in (one, two)]
        gone = contrasts[1] < 0.3 * contrasts[0] * min(light, 1.0)
        lit = float(np.median(((light_now + 2.0) / (light_then + 2.0))[both])) if both.sum() >= _FEWEST else light
        hidden = rich & gone & _hidden(lit * then, now, gone)
        covered = float(hidden.sum() / rich.sum()) if hidden.sum() >= _FEWEST else 0.0
    every = np.ones_like(weights)
    flip, flipped = _flip(*(_means(each, every).mean(axis=2) for each in (reference, picture)))
    return Looks(light, red, blue, sharp, covered, (plain + 0.03) / (other + 0.03), flip, flipped)


def _means(picture: NDArray[np.uint8], weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """The mean colour of each area, shape (rows, columns, 3)."""
    total = weights.sum(axis=2) + 1e-6
    channels = [(areas_of(picture[..., i].astype(np.float32)) * weights).sum(axis=2) / total for i in range(3)]
    return np.stack(channels, axis=2).astype(np.float64)


def _hidden(then: NDArray[np.float64], now: NDArray[np.float64], gone: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which areas are behind something, if there is nothing in them now, shape (rows, columns).

    Not those that are as bright as before: out of focus, what is large is still there. Nor those in which an object has
    left the table: they have the colour of an area nearby that is as it was. What covers the lens has its own.

    Args:
        then: the mean colour of each area, as it would be in the light of now, shape (rows, columns, 3).
        now: likewise.
        gone: where there is nothing now, but was, shape (rows, columns).
    """
    grey_then, grey_now = then.mean(axis=2), now.mean(axis=2)
    result: NDArray[np.bool_] = np.abs(grey_now - grey_then) >= _EQUAL * grey_then + _EQUAL_GREY
    same = ~gone & (np.abs(now - then) < _EQUAL * then + _EQUAL_GREY).all(axis=2)
    for row, column in np.argwhere(gone & result):
        around = tuple(slice(max(0, at - _AROUND), at + _AROUND + 1) for at in (row, column))
        near, own = now[around][same[around]], now[row, column]
        result[row, column] = not (np.abs(near - own) < _EQUAL * near + _EQUAL_GREY).all(axis=1).any()
    return result


def _deviation(values: Grey, weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """The deviation of the values in each area, shape (rows, columns)."""
    areas, total = areas_of(values), weights.sum(axis=2) + 1e-6
    mean = (areas * weights).sum(axis=2) / total
    result: NDArray[np.float64] = np.sqrt(((areas - mean[..., None]) ** 2 * weights).sum(axis=2) / total)
    return result


def _correlation(one: Grey, other: Grey, weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """The correlation of two pictures in each area, shape (rows, columns)."""
    total = weights.sum(axis=2) + 1e-6
    a, b = (each - ((each * weights).sum(axis=2) / total)[..., None] for each in (areas_of(one), areas_of(other)))
    norm = np.sqrt((a * a * weights).sum(axis=2) * (b * b * weights).sum(axis=2)) + 1e-6
    result: NDArray[np.float64] = (a * b * weights).sum(axis=2) / norm
    return result


def _colours(means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Red and blue in relation to green, shape (…, 2)."""
    result: NDArray[np.float64] = (means[..., [0, 2]] + 1.0) / (means[..., [1]] + 1.0)
    return result


def _details(values: Grey) -> Grey:
    result = np.zeros_like(values)
    inner = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:] - 4 * values[1:-1, 1:-1]
    result[1:-1, 1:-1] = inner
    return result


def _flip(then: NDArray[np.float64], now: NDArray[np.float64]) -> tuple[str, float]:
    def fits(each: NDArray[np.float64]) -> float:
        deviation = then.std() * each.std()
        product = ((then - then.mean()) * (each - each.mean())).mean()
        return float(product / deviation) if deviation > 1e-6 else 1.0

    own = 1.05 - fits(now)
    how, other = min(((name, 1.05 - fits(now[at])) for name, at in _FLIPS.items()), key=lambda each: each[1])
    return how, own / max(other, 1e-3)
