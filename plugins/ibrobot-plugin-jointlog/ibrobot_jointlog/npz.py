"""Dataset writer `npz`: one NumPy file per episode and one JSON file for metadata; and their reader."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, override
from zipfile import BadZipFile, ZipFile

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, DatasetWriter, Feature, replace_file

Values = Mapping[str, NDArray[np.generic]]
TASK = "task"
"""The column of tasks, in addition to the features."""


def _dtype(key: str, feature: Feature) -> np.dtype[Any]:
    """The array type of a feature; images are bytes."""
    try:
        dtype = np.dtype("uint8" if feature.dtype in ("image", "video") else feature.dtype)
    except TypeError:
        raise DatasetError(f"feature {key!r} has dtype {feature.dtype!r}, must be a NumPy type or image") from None
    if dtype.kind not in "biuf":
        raise DatasetError(f"feature {key!r} has dtype {feature.dtype!r}, must be bool, integer, float or image")
    return dtype


def _write_arrays(file: BinaryIO, arrays: Values) -> None:
    # Like numpy.savez, which cannot store some names, and pickles unknown types.
    with ZipFile(file, "w") as archive:
        for key, array in arrays.items():
            with archive.open(f"{key}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


class NpzDatasetWriter(DatasetWriter):
    """Writes `meta.json` and an `episode_000000.npz` per episode: an array (frames, *shape) per feature, and the tasks.

    All files are written atomically and without pickle.
    """

    def __init__(self) -> None:
        self._root: Path | None = None
        self._features: Mapping[str, Feature] = {}
        self._frames: list[dict[str, NDArray[np.generic]]] = []
        self._tasks: list[str] = []
        self._saved = 0

    @override
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        for key, feature in features.items():
            if key == TASK:
                raise DatasetError(f"no feature may be named {TASK!r}: this name is reserved for the tasks")
            _dtype(key, feature)
        facts = {
            "format": "npz",
            "fps": fps,
            "features": {key: attrs.asdict(feature) for key, feature in features.items()},
            "metadata": dict(metadata),
        }
        try:
            content = json.dumps(facts, indent=2, ensure_ascii=False, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise DatasetError(f"metadata cannot be written as JSON: {error}") from error
        try:
            if root.exists() and any(root.iterdir()):
                raise DatasetError(f"{root} is not empty: a new dataset needs an empty or new folder")
            root.mkdir(parents=True, exist_ok=True)
            replace_file(root / "meta.json", content)
        except OSError as error:
            raise DatasetError(f"cannot create a dataset in {root}: {error}") from error
        self._root, self._features, self._saved = root, dict(features), 0

    @override
    def add_frame(self, values: Values, task: str) -> None:
        self._open()
        for key in sorted(self._features.keys() ^ values.keys()):
            raise DatasetError(f"{key} is {'missing' if key in self._features else 'not a feature of this dataset'}")
        frame: dict[str, NDArray[np.generic]] = {}
        for key, feature in self._features.items():
            value, dtype = np.asarray(values[key]), _dtype(key, feature)
            if value.shape != feature.shape:
                raise DatasetError(f"{key} has shape {value.shape}, must be {feature.shape}")
            if not np.can_cast(value.dtype, dtype, "same_kind"):
                raise DatasetError(f"{key} has dtype {value.dtype}, must be {dtype}")
            frame[key] = value.astype(dtype)
        self._frames.append(frame)
        self._tasks.append(task)

    @override
    def save_episode(self) -> int:
        root = self._open()
        if not self._frames:
            raise DatasetError("the episode has no frames: call add_frame before save_episode")
        columns = {key: np.stack([frame[key] for frame in self._frames]) for key in self._features}
        columns[TASK] = np.array(self._tasks)
        path = root / f"episode_{self._saved:06d}.npz"
        try:
            replace_file(path, lambda file: _write_arrays(file, columns))
        except OSError as error:
            raise DatasetError(f"{path}: {error}") from error
        self._frames, self._tasks = [], []
        self._saved += 1
        return self._saved - 1

    @override
    def finalize(self) -> None:
        self._root, self._frames, self._tasks = None, [], []

    def _open(self) -> Path:
        if self._root is None:
            raise DatasetError("no dataset is open: call create first, finalize last")
        return self._root


@attrs.frozen
class NpzDataset:
    """A dataset on disk; episodes are read on demand."""

    root: Path
    fps: float
    features: Mapping[str, Feature]
    metadata: Mapping[str, Any]
    episodes: tuple[Path, ...]
    """The saved episodes' files, in order."""

    def episode(self, index: int) -> dict[str, NDArray[np.generic]]:
        """Episode `index`: key -> its frames, shape (frames, *feature shape), and `task`, shape (frames,).

        Raises:
            DatasetError: if the index is out of range, or the file is not an episode of this dataset.
        """
        if not 0 <= index < len(self.episodes):
            raise DatasetError(f"no episode {index} in {self.root}; it has {len(self.episodes)}, counted from 0")
        path = self.episodes[index]
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                columns = {key: archive[key] for key in archive.files}
        except (OSError, ValueError, EOFError, BadZipFile) as error:
            raise DatasetError(f"{path}: {error}") from error
        if columns.keys() != {*self.features, TASK}:
            raise DatasetError(
                f"{path} has {', '.join(sorted(columns))}, must have {', '.join((*self.features, TASK))}"
            )
        return columns


def read_npz(root: Path) -> NpzDataset:
    """Open a dataset, finalised or not.

    Raises:
        DatasetError: if there is none in `root`.
    """
    path = root / "meta.json"
    try:
        facts = json.loads(path.read_bytes())
        features = {
            key: Feature(f["dtype"], tuple(f["shape"]), tuple(f["names"])) for key, f in facts["features"].items()
        }
        fps, metadata = facts["fps"], facts["metadata"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{path}: is not an npz dataset: {error!r}") from error
    return NpzDataset(root, fps, features, metadata, tuple(sorted(root.glob("episode_*.npz"))))
