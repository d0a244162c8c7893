"""The dataset suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import override

import numpy as np
import pytest
from ibrobot_provenance.dataset_suite import DatasetSuite
from ibrobot_provenance.fakes import FakeDataset
from ibrobot_testing import checks, failed_checks

from ibrobot_core.api import DatasetError


class TestDataset(DatasetSuite):
    @override
    def make(self, ctx):
        return FakeDataset(ctx)

    @override
    def read_back(self, root):
        return [dict(np.load(path)) for path in sorted(root.glob("episode_*.npz"))]

    @override
    def read_tasks(self, root):
        return [values["task"].tolist() for values in self.read_back(root)]


class OneTaskForAll(FakeDataset):
    """Gives all frames the task of the first one."""

    first = ""

    def add_frame(self, values, task):
        self.first = self.first or task
        super().add_frame(values, self.first)


class NeedsTheFolderAbove(FakeDataset):
    def create(self, root, fps, features, metadata):
        if not root.parent.is_dir():
            raise DatasetError(f"{root.parent} does not exist")
        super().create(root, fps, features, metadata)


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
    OneTaskForAll: "keeps_the_tasks",
    NeedsTheFolderAbove: "gives_back_what_was_written",
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
