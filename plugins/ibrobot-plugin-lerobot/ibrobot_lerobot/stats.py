"""Statistics of features over all rows of a dataset, with LeRobot's names and shapes, without keeping images in memory.

LeRobot 0.6.1 averages the quantiles of the episodes. If episodes differ, many values are then outside [q01, q99]. Here,
quantiles are computed over all rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature

Stats = dict[str, NDArray[Any]]
"""`min`, `max`, `mean`, `std`, `count` (shape (1,)), `q01` to `q99`."""

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_LARGE = 300
_SAMPLED = 150


def vector_stats(values: NDArray[Any]) -> Stats:
    """Statistics of vectors, shape (N, D), N >= 1: each of shape (D,)."""
    values = values.astype(np.float64)
    stats = {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
    }
    return stats | dict(zip(QUANTILES, np.quantile(values, list(QUANTILES.values()), axis=0), strict=True))


class PixelStats:
    """Exact statistics of the pixels of uint8 images, per channel, divided by 255: each of shape (C, 1, 1).

    All images are included; large ones are subsampled as in LeRobot, to about 150 pixels along the longer side.
    """

    def __init__(self, channels: int) -> None:
        self._histogram = np.zeros((channels, 256), np.int64)
        self._pictures = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add an image, shape (H, W, C)."""
        step = thinning(*image.shape[:2])
        thinned = image[::step, ::step]
        for channel in range(len(self._histogram)):
            self._histogram[channel] += np.bincount(thinned[..., channel].ravel(), minlength=256)
        self._pictures += 1

    def stats(self) -> Stats:
        """The statistics, after at least one image."""
        values = np.arange(256) / 255.0
        share = self._histogram / self._histogram.sum(1, keepdims=True)
        mean = share @ values
        seen = self._histogram > 0
        stats = {
            "min": values[seen.argmax(1)],
            "max": values[255 - seen[:, ::-1].argmax(1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(share @ values**2 - mean**2, 0.0)),
        }
        stats |= {name: values[_below(self._histogram, share)] for name, share in QUANTILES.items()}
        shaped: Stats = {name: value.reshape(-1, 1, 1) for name, value in stats.items()}
        return shaped | {"count": np.array([self._pictures])}

    def state(self) -> dict[str, Any]:
        """The counts as JSON values, for `join`."""
        return {"pictures": self._pictures, "histogram": self._histogram.tolist()}

    def join(self, state: Mapping[str, Any]) -> None:
        """Add the counts of another object."""
        self._histogram += np.array(state["histogram"], np.int64)
        self._pictures += state["pictures"]


class DepthStats:
    """Statistics of depth images in their own unit: each of shape (1, 1, 1).

    Quantiles of uint16 are exact. Those of float32 have an error of at most 0.4 %: values are counted in bins by their
    upper 16 bits, which preserve the order. A quantile is the centre of a bin, whose width is 2**-7 of its value.
    """

    def __init__(self, dtype: str) -> None:
        self._dtype = np.dtype(dtype)
        self._histogram = np.zeros((1, 1 << 16), np.int64)
        self._moments = np.zeros(2)
        """Sum, and sum of squares."""
        self._range = np.array([np.inf, -np.inf])
        self._pictures = 0

    def add(self, depth: NDArray[Any]) -> None:
        """Add a depth image, shape (H, W, 1)."""
        step = thinning(*depth.shape[:2])
        values = np.ascontiguousarray(depth[::step, ::step]).astype(self._dtype, copy=False).ravel()
        if self._dtype.kind == "f" and not (np.isfinite(values) & (values >= 0)).all():
            raise DatasetError("a depth image has values that are negative or not finite")
        bins = values if self._dtype.kind == "u" else np.abs(values).view(np.uint32) >> 16
        self._histogram[0] += np.bincount(bins, minlength=1 << 16)
        exact = values.astype(np.float64)
        self._moments += [exact.sum(), (exact**2).sum()]
        self._range = np.array([min(self._range[0], exact.min()), max(self._range[1], exact.max())])
        self._pictures += 1

    def stats(self) -> Stats:
        """The statistics, after at least one image."""
        mean, square = self._moments / self._histogram.sum()
        stats = {"min": self._range[0], "max": self._range[1], "mean": mean, "std": np.sqrt(max(square - mean**2, 0.0))}
        for name, share in QUANTILES.items():
            stats[name] = np.clip(self._value(_below(self._histogram, share)), *self._range)
        shaped: Stats = {name: np.reshape(value, (1, 1, 1)) for name, value in stats.items()}
        return shaped | {"count": np.array([self._pictures])}

    def state(self) -> dict[str, Any]:
        """The counts as JSON values, for `join`."""
        (bins,) = self._histogram[0].nonzero()
        return {
            "pictures": self._pictures,
            "moments": self._moments.tolist(),
            "range": self._range.tolist(),
            "bins": bins.tolist(),
            "histogram": self._histogram[0, bins].tolist(),
        }

    def join(self, state: Mapping[str, Any]) -> None:
        """Add the counts of another object."""
        self._histogram[0, state["bins"]] += np.array(state["histogram"], np.int64)
        self._moments += state["moments"]
        low, high = state["range"]
        self._range = np.array([min(self._range[0], low), max(self._range[1], high)])
        self._pictures += state["pictures"]

    def _value(self, number: NDArray[np.intp]) -> NDArray[np.float64]:
        """The centre of a bin."""
        if self._dtype.kind == "u":
            return number.astype(np.float64)
        edges = [((number + i).astype(np.uint32) << 16).view(np.float32).astype(np.float64) for i in (0, 1)]
        return (edges[0] + edges[1]) / 2


PictureStats = PixelStats | DepthStats


def picture_stats(feature: Feature) -> PictureStats:
    """Empty statistics of a camera's images."""
    return PixelStats(feature.shape[2]) if feature.dtype == "image" else DepthStats(feature.dtype)


def thinning(height: int, width: int) -> int:
    """The subsampling factor of an image for its statistics: every n-th pixel along both sides."""
    longer = max(height, width)
    return 1 if longer < _LARGE else longer // _SAMPLED


def _below(histogram: NDArray[np.int64], share: float) -> NDArray[np.intp]:
    """The first bin of each row at which the cumulative count reaches `share` of the row's total."""
    counted = np.cumsum(histogram, 1)
    return (counted >= share * counted[:, -1:]).argmax(1)
