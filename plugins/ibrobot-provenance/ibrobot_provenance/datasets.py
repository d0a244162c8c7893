"""Dataset writers, which write frames as training sets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import Descriptor, NotSupported

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ibrobot_core.api import Contract, Feature, ObservationPart


@attrs.frozen
class DatasetSummary:
    """Summary of a dataset on disk, available without reading its frames."""

    fps: float
    features: Mapping[str, Feature]
    metadata: Mapping[str, Any]
    """The metadata passed to `create` or `merge`; empty if another program wrote the dataset."""
    episodes: int
    frames: int


class DatasetWriter(ABC):
    """Appends episodes to a dataset. Saved episodes persist even if the dataset is not finalised.

    Args of implementations: options, ctx; then `create`.
    """

    @abstractmethod
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        """Begin a dataset in `root`, which must not exist or be empty.

        Raises:
            DatasetError: if `root` is not empty.
        """

    @abstractmethod
    def add_frame(self, values: Mapping[str, NDArray[np.generic]], task: str) -> None:
        """Append a frame to the open episode, with a value of the right shape for every feature.

        Raises:
            DatasetError: if a value is missing, unknown or misshapen; the episode is unchanged.
        """

    @abstractmethod
    def save_episode(self) -> int:
        """Close the open episode and return its index; from now on it survives a crash.

        Raises:
            DatasetError: if the episode has no frames.
        """

    @abstractmethod
    def finalize(self) -> None:
        """Finish the dataset; frames of an unsaved episode are dropped. Safe to call twice."""

    def summary(self, root: Path) -> DatasetSummary | None:
        """Summary of the finished dataset at `root`; None if there is none.

        Raises:
            DatasetError: if it cannot be read.
            NotSupported: by default.
        """
        raise NotSupported(f"{type(self).__name__} does not read datasets back")

    def merge(self, root: Path, parts: Sequence[Path], metadata: Mapping[str, Any]) -> None:
        """Append finished datasets of this writer to the one at `root`, which is created if it does not exist.

        Nothing is re-encoded, and equal parts give equal bytes. A crash leaves either the old or the new dataset: the
        next call of `merge` or `summary` completes a merge that was interrupted during its final step.

        Args:
            root: folder of the dataset.
            parts: datasets with the same rate and features, in the order of their episodes.
            metadata: new metadata of the whole dataset.

        Raises:
            DatasetError: if a part does not fit, or the disk is full; the existing dataset is unchanged.
            NotSupported: by default.
        """
        raise NotSupported(f"{type(self).__name__} does not merge datasets")


@attrs.frozen
class DatasetDescriptor(Descriptor[DatasetWriter]):
    """A dataset writer."""

    flags: tuple[str, ...] = ()
    """The options that are flags of the convert command, too."""


def element_names(names: Any) -> tuple[str, ...]:
    """The names of a feature's elements, in their order; empty if they are absent or have no known order.

    LeRobot and its converters write a list, a list in a dict (`{"motors": ["pan", "lift"]}`) or positions
    (`{"pan": 0, "lift": 1}`). Several lists in a dict do not say which comes first.

    Args:
        names: `names` in the feature's entry of `info.json`.
    """
    while isinstance(names, dict | list) and len(names) == 1:
        [inner] = names.values() if isinstance(names, dict) else names
        if not isinstance(inner, dict | list):
            break
        names = inner
    if isinstance(names, dict):
        places = {place: name for name, place in names.items() if type(place) is int}
        names = [places.get(place) for place in range(len(names))]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return ()
    return tuple(names)


def with_pinholes(contract: Contract) -> Contract:
    """The contract of a dataset's pictures: where the conversion has removed a lens's distortion, there is none."""
    return attrs.evolve(contract, observation_parts=tuple(map(_with_pinhole, contract.observation_parts)))


def _with_pinhole(part: ObservationPart) -> ObservationPart:
    """A camera without distortion, which changes no picture, whatever its focal length."""
    if "rectify" not in part.model:
        return part
    height, width, _ = part.feature.shape
    size = {"width": width, "height": height} if min(width, height) > 0 else {}
    k = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    p = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    lens = {**part.model["rectify"], **size, "distortion_model": "plumb_bob", "d": [], "k": k, "r": k, "p": p}
    return attrs.evolve(part, model={"rectify": lens})
