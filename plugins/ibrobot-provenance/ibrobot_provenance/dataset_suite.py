"""The conformance suite of dataset writers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from ibrobot_testing.suite import Suite
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature
from ibrobot_provenance.datasets import DatasetWriter

Values = Mapping[str, NDArray[np.generic]]


class DatasetSuite(Suite[DatasetWriter]):
    """Checks of every `DatasetWriter`. The subclass defines `read_back`."""

    fps: ClassVar[float] = 30.0
    features: ClassVar[Mapping[str, Feature]] = {
        "observation.state": Feature("float32", (3,), ("a", "b", "c")),
        "action": Feature("float32", (2,), ("a", "b")),
    }
    """Features whose values must be reproduced bit by bit."""

    def read_back(self, root: Path) -> Sequence[Values]:
        """The saved episodes in order, as key -> frames stacked along the first axis; also before `finalize`."""
        raise NotImplementedError(f"{type(self).__name__} must define read_back(self, root)")

    def read_tasks(self, root: Path) -> Sequence[Sequence[str]]:
        """The tasks of the saved episodes' frames, in order. Override it to have them checked."""
        pytest.skip("override read_tasks to have tasks checked")

    def created(self, root: Path) -> DatasetWriter:
        """A new dataset in `root`."""
        writer = self.make(self.context())
        writer.create(root, self.fps, self.features, {"robot_type": "tester"})
        return writer

    def frame(self, i: int) -> dict[str, NDArray[np.generic]]:
        """Values of frame `i`: different for each."""
        rng = np.random.default_rng(i)
        return {key: rng.normal(size=f.shape).astype(f.dtype) for key, f in self.features.items()}

    def _add(self, writer: DatasetWriter, *numbers: int) -> None:
        for i in numbers:
            writer.add_frame(self.frame(i), "pick")

    def _check(self, root: Path, episodes: Sequence[Sequence[int]]) -> None:
        frames = self.read_back(root)
        assert len(frames) == len(episodes), f"{len(frames)} episodes, not {len(episodes)}"
        for values, numbers in zip(frames, episodes, strict=True):
            for key in self.features:
                wanted = np.stack([self.frame(i)[key] for i in numbers])
                np.testing.assert_array_equal(values[key], wanted, err_msg=key)

    def test_gives_back_what_was_written(self, tmp_path: Path) -> None:
        """Episodes are numbered from 0, and every value is reproduced bit by bit; the folder may be a new one's."""
        root = tmp_path / "new" / "set"
        writer = self.created(root)
        for episode, numbers in enumerate(((0, 1, 2), (3, 4))):
            self._add(writer, *numbers)
            assert writer.save_episode() == episode
        writer.finalize()
        self._check(root, [(0, 1, 2), (3, 4)])

    def test_keeps_the_tasks(self, tmp_path: Path) -> None:
        """Each frame keeps its task."""
        writer = self.created(tmp_path / "set")
        for tasks in (("pick", "pick"), ("place",)):
            for i, task in enumerate(tasks):
                writer.add_frame(self.frame(i), task)
            writer.save_episode()
        writer.finalize()
        assert [list(each) for each in self.read_tasks(tmp_path / "set")] == [["pick", "pick"], ["place"]]

    def test_never_writes_over_anything(self, tmp_path: Path) -> None:
        """A non-empty root is refused and not changed; an empty one is accepted."""
        (tmp_path / "empty").mkdir()
        writer = self.created(tmp_path / "empty")
        writer.finalize()
        (tmp_path / "full").mkdir()
        (tmp_path / "full" / "old.txt").write_text("old")
        with pytest.raises(DatasetError):
            self.created(tmp_path / "full")
        assert [p.name for p in (tmp_path / "full").iterdir()] == ["old.txt"]

    def test_refuses_frames_that_do_not_fit(self, tmp_path: Path) -> None:
        """A missing, unknown or misshapen value is a DatasetError that names it; the episode is unchanged."""
        writer = self.created(tmp_path / "set")
        writer.add_frame(self.frame(0), "pick")
        key = next(iter(self.features))
        missing = {k: v for k, v in self.frame(1).items() if k != key}
        misshapen = {**self.frame(1), key: np.zeros(7, np.float32)}
        for wrong, name in ((missing, key), ({**self.frame(1), "extra": np.zeros(1)}, "extra"), (misshapen, key)):
            with pytest.raises(DatasetError, match=name):
                writer.add_frame(wrong, "pick")
        writer.add_frame(self.frame(2), "pick")
        writer.save_episode()
        writer.finalize()
        self._check(tmp_path / "set", [(0, 2)])

    def test_refuses_an_empty_episode(self, tmp_path: Path) -> None:
        """`save_episode` without frames is a DatasetError."""
        writer = self.created(tmp_path / "set")
        with pytest.raises(DatasetError):
            writer.save_episode()
        writer.add_frame(self.frame(0), "pick")
        assert writer.save_episode() == 0
        with pytest.raises(DatasetError):
            writer.save_episode()
        writer.finalize()
        self._check(tmp_path / "set", [(0,)])

    def test_a_saved_episode_survives(self, tmp_path: Path) -> None:
        """Saved episodes can be read before, and without, `finalize`."""
        writer = self.created(tmp_path / "set")
        try:
            self._add(writer, 0)
            writer.save_episode()
            self._add(writer, 1)
            self._check(tmp_path / "set", [(0,)])
        finally:
            writer.finalize()

    def test_finalize_drops_what_was_not_saved(self, tmp_path: Path) -> None:
        """Frames of an open episode are dropped; `finalize` is safe twice."""
        writer = self.created(tmp_path / "set")
        writer.add_frame(self.frame(0), "pick")
        writer.save_episode()
        writer.add_frame(self.frame(1), "pick")
        writer.finalize()
        writer.finalize()
        self._check(tmp_path / "set", [(0,)])

    def test_frames_are_taken_as_they_were(self, tmp_path: Path) -> None:
        """An array that changes after `add_frame` does not change the dataset."""
        writer = self.created(tmp_path / "set")
        values = self.frame(0)
        writer.add_frame(values, "pick")
        for value in values.values():
            value[...] = 0
        writer.save_episode()
        writer.finalize()
        self._check(tmp_path / "set", [(0,)])

    def test_refuses_frames_before_create(self) -> None:
        """`add_frame` before `create` is a DatasetError."""
        with pytest.raises(DatasetError):
            self.make(self.context()).add_frame(self.frame(0), "pick")
