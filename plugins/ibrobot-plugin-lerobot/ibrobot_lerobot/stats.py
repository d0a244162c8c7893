"""Statistics of features, by LeRobot's names and shapes: exact within an episode, whole pictures never in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Stats = dict[str, NDArray[Any]]
"""`min`, `max`, `mean`, `std`, `count` (shape (1,)), `q01` to `q99`."""

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_LARGE = 300
_SAMPLED = 150


def vector_stats(values: NDArray[Any]) -> Stats:
    """Statistics of vectors, shape (N, D), N >= 1: each of shape (D,)."""
    values = values.astype(np.float64)
    stats = {
        "min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0),
        "count": np.array([len(values)]),
    }  # fmt: skip
    return stats | dict(zip(QUANTILES, np.quantile(values, list(QUANTILES.values()), axis=0), strict=True))


class PixelStats:
    """Statistics of the pixels of uint8 pictures, per channel and over 255: each of shape (C, 1, 1).

    Large pictures are thinned out as LeRobot does it, to about 150 pixels along the longer side.
    """

    def __init__(self, channels: int) -> None:
        self._histogram = np.zeros((channels, 256), np.int64)
        self._pictures = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Count a picture, shape (H, W, C)."""
        step = thinning(*image.shape[:2])
        thinned = image[::step, ::step]
        for channel in range(len(self._histogram)):
            self._histogram[channel] += np.bincount(thinned[..., channel].ravel(), minlength=256)
        self._pictures += 1

    def stats(self) -> Stats:
        """Of what was counted, at least one picture."""
        values = np.arange(256) / 255.0
        share = self._histogram / self._histogram.sum(1, keepdims=True)
        mean = share @ values
        below = np.cumsum(self._histogram, 1)
        seen = self._histogram > 0
        stats = {
            "min": values[seen.argmax(1)],
            "max": values[255 - seen[:, ::-1].argmax(1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(share @ values**2 - mean**2, 0.0)),
        }
        for name, quantile in QUANTILES.items():
            wanted = quantile * below[:, -1:]
            stats[name] = values[(below >= wanted).argmax(1)]
        shaped: Stats = {name: value.reshape(-1, 1, 1) for name, value in stats.items()}
        return shaped | {"count": np.array([self._pictures])}


class DepthStats:
    """Statistics of depth pictures in their own unit: each of shape (1, 1, 1). Quantiles are means over pictures."""

    def __init__(self) -> None:
        self._joined: Stats = {}
        self._pictures = 0

    def add(self, depth: NDArray[Any]) -> None:
        """Count a picture, shape (H, W, 1)."""
        step = thinning(*depth.shape[:2])
        stats = vector_stats(depth[::step, ::step].reshape(-1, 1))
        self._joined = aggregate([self._joined, stats]) if self._pictures else stats
        self._pictures += 1

    def stats(self) -> Stats:
        """Of what was counted, at least one picture."""
        shaped: Stats = {name: value.reshape(-1, 1, 1) for name, value in self._joined.items()}
        return shaped | {"count": np.array([self._pictures])}


def thinning(height: int, width: int) -> int:
    """Which pixels of a picture count for its statistics: every n-th along both sides."""
    longer = max(height, width)
    return 1 if longer < _LARGE else longer // _SAMPLED


def aggregate(each: Sequence[Stats]) -> Stats:
    """Statistics of several episodes together, as LeRobot joins them: quantiles are means weighted by count."""
    weights = np.array([stats["count"][0] for stats in each], dtype=np.float64)
    weights /= weights.sum()

    def weighted(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        mean: NDArray[Any] = np.tensordot(weights, np.stack(values), 1)
        return mean

    mean = weighted([stats["mean"] for stats in each])
    variance = weighted([stats["std"] ** 2 + (stats["mean"] - mean) ** 2 for stats in each])
    joined: Stats = {
        "min": np.min([stats["min"] for stats in each], axis=0),
        "max": np.max([stats["max"] for stats in each], axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.sum([stats["count"] for stats in each], axis=0),
    }
    return joined | {name: weighted([stats[name] for stats in each]) for name in QUANTILES}
