"""Dataset writer `lerobot`: writes every episode as a separate dataset; `finalize` merges them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, override

import numpy as np
from ibrobot_provenance.datasets import DatasetSummary, DatasetWriter
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature
from ibrobot_lerobot import layout
from ibrobot_lerobot.episode import EpisodeWriter, Format
from ibrobot_lerobot.merge import adopt, complete, merge
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.video import choose_encoder

_SAVED = ".episodes"
"""Folder of saved episodes before `finalize`."""


class LeRobotDatasetWriter(DatasetWriter):
    """Writes LeRobot's format v3.0.

    Saved episodes are separate LeRobot datasets in `ROOT/.episodes/000000`, … until `finalize` merges them, so that a
    killed process loses none of them.

    `metadata` contains `robot_type` and is stored in `meta/ibrobot.json`.
    """

    def __init__(self, options: LeRobotOptions) -> None:
        self._options = options
        self._root: Path | None = None
        self._form: Format | None = None
        self._metadata: Mapping[str, Any] = {}
        self._open: EpisodeWriter | None = None
        self._saved: list[Path] = []

    @override
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        options = self._options
        if fps != int(fps) or fps < 1:
            raise DatasetError(f"LeRobot needs a whole number of frames per second; contract.rate_hz is {fps:g}")
        stored = layout.columns(features, videos=options.videos)
        videos = [column.feature.shape for column in stored.values() if column.storage == "video"]
        encoder = choose_encoder(options, videos) if videos else None
        robot_type = str(metadata.get("robot_type", ""))
        info = layout.new_info(stored, int(fps), robot_type, options.table_file_mb, options.video_file_mb)
        try:
            json.dumps(dict(metadata), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise DatasetError(f"metadata cannot be written as JSON: {error}") from error
        try:
            if root.exists() and any(root.iterdir()):
                raise DatasetError(f"{root} is not empty: a new dataset needs an empty or new folder")
            (root / _SAVED).mkdir(parents=True)
        except OSError as error:
            raise DatasetError(f"cannot create a dataset in {root}: {error}") from error
        self._root, self._metadata, self._saved = root, dict(metadata), []
        self._form = Format(stored, int(fps), encoder, info)

    @override
    def add_frame(self, values: Mapping[str, NDArray[np.generic]], task: str) -> None:
        root, form = self._created()
        for key in sorted(form.stored.keys() ^ values.keys()):
            raise DatasetError(f"{key} is {'missing' if key in form.stored else 'not a feature of this dataset'}")
        frame = {key: _fitting(key, column.feature, values[key]) for key, column in form.stored.items()}
        if self._open is None:
            path = root / _SAVED / f"{len(self._saved):06d}.open"
            try:
                shutil.rmtree(path, ignore_errors=True)
                self._open = EpisodeWriter(path, form, self._metadata)
            except OSError as error:
                raise DatasetError(f"{path}: {error}") from error
        self._open.add(frame, task)

    @override
    def save_episode(self) -> int:
        root, _ = self._created()
        if self._open is None:
            raise DatasetError("the episode has no frames: call add_frame before save_episode")
        episode, self._open = self._open, None
        episode.close()
        number = len(self._saved)
        path = root / _SAVED / f"{number:06d}"
        try:
            path.with_suffix(".open").rename(path)
        except OSError as error:
            raise DatasetError(f"{path}: {error}") from error
        self._saved.append(path)
        return number

    @override
    def finalize(self) -> None:
        if self._root is None:
            return
        root, self._root = self._root, None
        if self._open is not None:
            self._open.abort()
            self._open = None
        if len(self._saved) == 1:
            adopt(root, self._saved[0])
        elif self._saved:
            merge(root, self._saved, self._metadata)
        shutil.rmtree(root / _SAVED, ignore_errors=True)

    @override
    def summary(self, root: Path) -> DatasetSummary | None:
        complete(root)
        dataset = layout.open_dataset(root)
        if dataset is None:
            return None
        info = dataset.info
        return DatasetSummary(
            info["fps"], dataset.features, dataset.metadata, info["total_episodes"], info["total_frames"]
        )

    @override
    def merge(self, root: Path, parts: Sequence[Path], metadata: Mapping[str, Any]) -> None:
        merge(root, parts, metadata)

    def _created(self) -> tuple[Path, Format]:
        if self._root is None or self._form is None:
            raise DatasetError("no dataset is open: call create first, finalize last")
        return self._root, self._form


def _fitting(key: str, feature: Feature, value: NDArray[np.generic]) -> NDArray[Any]:
    """The value in its stored form."""
    value = np.asarray(value)
    dtype = np.dtype("uint8" if feature.dtype == "image" else feature.dtype)
    if value.shape != feature.shape:
        raise DatasetError(f"{key} has shape {value.shape}, must be {feature.shape}")
    if not np.can_cast(value.dtype, dtype, "same_kind"):
        raise DatasetError(f"{key} has dtype {value.dtype}, must be {dtype}")
    return value.astype(dtype, copy=False)
