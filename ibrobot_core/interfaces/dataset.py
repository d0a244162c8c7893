"""Dataset writers: what turns frames into a training set on disk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import NotSupported


@attrs.frozen
class Feature:
    """One column of a dataset, as LeRobot describes it."""

    dtype: str
    """`float32`, `image`, …"""
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()


@attrs.frozen
class DatasetSummary:
    """What is known of a dataset on disk without reading its frames."""

    fps: float
    features: Mapping[str, Feature]
    metadata: Mapping[str, Any]
    """The metadata given to `create` or `merge`; empty for a dataset that was not written by this writer."""
    episodes: int
    frames: int


class DatasetWriter(ABC):
    """Appends episodes to a dataset. A dataset that was not finalised keeps every saved episode.

    Args of implementations: options, ctx; then `create`.
    """

    @abstractmethod
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        """Begin a dataset in `root`, which must not exist or be empty.

        Raises:
            DatasetError: when there is something in `root`.
        """

    @abstractmethod
    def add_frame(self, values: Mapping[str, NDArray[np.generic]], task: str) -> None:
        """Append a frame to the open episode: exactly the features, each of its shape.

        Raises:
            DatasetError: for a missing, unknown or misshapen value; the episode stays as it was.
        """

    @abstractmethod
    def save_episode(self) -> int:
        """Close the open episode and return its index; it survives a crash from here on.

        Raises:
            DatasetError: for an episode without frames.
        """

    @abstractmethod
    def finalize(self) -> None:
        """Finish the dataset; frames of an episode not saved are dropped. Safe to call twice."""

    def summary(self, root: Path) -> DatasetSummary | None:
        """What is in the finished dataset at `root`; None where there is none.

        Raises:
            DatasetError: when it cannot be read.
            NotSupported: by default.
        """
        raise NotSupported(f"{type(self).__name__} does not read datasets back")

    def merge(self, root: Path, parts: Sequence[Path], metadata: Mapping[str, Any]) -> None:
        """Append finished datasets of this writer to the one at `root`, or make it of them where there is none.

        Nothing is re-encoded, equal parts give equal bytes, and a crash leaves the old dataset or the new one: a
        merge that was interrupted once it was certain is completed by the next call of `merge` or `summary`.

        Args:
            root: where the dataset is or shall be.
            parts: datasets of the same rate and features, in the order in which their episodes come.
            metadata: of the whole, in place of what was there.

        Raises:
            DatasetError: for a part that does not fit, or a full disk; what was there stays as it was.
            NotSupported: by default.
        """
        raise NotSupported(f"{type(self).__name__} does not merge datasets")
