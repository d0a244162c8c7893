"""Dataset writers: what turns frames into a training set on disk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray


@attrs.frozen
class Feature:
    """One column of a dataset, as LeRobot describes it."""

    dtype: str
    """`float32`, `image`, …"""
    shape: tuple[int, ...]
    names: tuple[str, ...] = ()


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
