"""The dataset suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, override

import numpy as np
import pytest
from ibrobot_provenance.dataset_suite import DatasetSuite
from ibrobot_provenance.datasets import DatasetWriter
from ibrobot_testing import checks, failed_checks
from numpy.typing import NDArray

from ibrobot_core.api import Context, DatasetError, Feature


class FakeDataset(DatasetWriter):
    """Writes each episode to `episode_N.npz`: one array per feature, and the tasks."""

    def __init__(self, ctx: Context) -> None:
        self._root: Path | None = None
        self._features: Mapping[str, Feature] = {}
        self._frames: list[dict[str, NDArray[np.generic]]] = []
        self._episodes = 0

    @override
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        if root.exists() and any(root.iterdir()):
            raise DatasetError(f"{root} is not empty")
        root.mkdir(parents=True, exist_ok=True)
        (root / "metadata.json").write_text(json.dumps({"fps": fps, **metadata}))
        self._root, self._features = root, features

    @override
    def add_frame(self, values: Mapping[str, NDArray[np.generic]], task: str) -> None:
        if self._root is None:
            raise DatasetError("create comes before add_frame")
        for key in sorted(self._features.keys() ^ values.keys()):
            raise DatasetError(f"{key} is {'missing' if key in self._features else 'not a feature of this dataset'}")
        for key, feature in self._features.items():
            if values[key].shape != feature.shape:
                raise DatasetError(f"{key} must have shape {feature.shape}, got {values[key].shape}")
        self._frames.append({key: np.array(value) for key, value in values.items()} | {"task": np.array(task)})

    @override
    def save_episode(self) -> int:
        if self._root is None or not self._frames:
            raise DatasetError("the episode has no frames")
        columns = {key: np.stack([frame[key] for frame in self._frames]) for key in self._frames[0]}
        np.savez(self._root / f"episode_{self._episodes}.npz", **columns)  # type: ignore[arg-type]
        self._frames = []
        self._episodes += 1
        return self._episodes - 1

    @override
    def finalize(self) -> None:
        self._frames = []


class TestDataset(DatasetSuite):
    @override
    def make(self, ctx):
        return FakeDataset(ctx)

    @override
    def read_back(self, root):
        return [dict(np.load(path)) for path in sorted(root.glob("episode_*.npz"))]


class HalfPrecision(FakeDataset):
    def add_frame(self, values, task):
        super().add_frame({key: value.astype(np.float16) for key, value in values.items()}, task)


class CountsFromOne(FakeDataset):
    def save_episode(self):
        return super().save_episode() + 1


class WritesOver(FakeDataset):
    def create(self, root, fps, features, metadata):
        for path in root.iterdir() if root.exists() else ():
            path.unlink()
        super().create(root, fps, features, metadata)


class FillsWithZeros(FakeDataset):
    def add_frame(self, values, task):
        zeros = {key: np.zeros(feature.shape, np.float32) for key, feature in self._features.items()}
        super().add_frame({**zeros, **values}, task)


class KeepsTheBadFrame(FakeDataset):
    def add_frame(self, values, task):
        try:
            super().add_frame(values, task)
        except DatasetError:
            self._frames.append(self._frames[-1])
            raise


class SavesEmptyEpisodes(FakeDataset):
    def save_episode(self):
        return super().save_episode() if self._frames else self._episodes


class SavesWhenFinalized(FakeDataset):
    def __init__(self, ctx):
        super().__init__(ctx)
        self._waiting = []

    def save_episode(self):
        if not self._frames:
            raise DatasetError("the episode has no frames")
        self._waiting.append(self._frames)
        self._frames = []
        return len(self._waiting) - 1

    def finalize(self):
        for frames in self._waiting:
            self._frames = frames
            super().save_episode()
        self._waiting = []
        super().finalize()


class SavesTheOpenEpisode(FakeDataset):
    def finalize(self):
        if self._frames:
            self.save_episode()


class KeepsTheCallersArrays(FakeDataset):
    def add_frame(self, values, task):
        super().add_frame(values, task)
        self._frames[-1].update(values)


class IgnoresFramesBeforeCreate(FakeDataset):
    def add_frame(self, values, task):
        if self._root is not None:
            super().add_frame(values, task)


WRONG = {
    HalfPrecision: "gives_back_what_was_written",
    CountsFromOne: "gives_back_what_was_written",
    WritesOver: "never_writes_over_anything",
    FillsWithZeros: "refuses_frames_that_do_not_fit",
    KeepsTheBadFrame: "refuses_frames_that_do_not_fit",
    SavesEmptyEpisodes: "refuses_an_empty_episode",
    SavesWhenFinalized: "a_saved_episode_survives",
    SavesTheOpenEpisode: "finalize_drops_what_was_not_saved",
    KeepsTheCallersArrays: "frames_are_taken_as_they_were",
    IgnoresFramesBeforeCreate: "refuses_frames_before_create",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestDataset):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(DatasetSuite) == set(WRONG.values())
