"""The NPZ dataset writer and its reader."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import override

import numpy as np
import pytest
from ibrobot_jointlog import ibrobot_datasets
from ibrobot_jointlog.npz import NpzDatasetWriter, read_npz
from ibrobot_testing import DatasetSuite, host_context
from numpy.typing import NDArray

from ibrobot_core.api import Context, DatasetError, Feature

STATE = {"state": Feature("float32", (2,), ("a", "b"))}


class TestNpzDatasetWriter(DatasetSuite):
    @override
    def make(self, ctx: Context) -> NpzDatasetWriter:
        return NpzDatasetWriter()

    @override
    def read_back(self, root: Path) -> Sequence[Mapping[str, NDArray[np.generic]]]:
        dataset = read_npz(root)
        return [dataset.episode(i) for i in range(len(dataset.episodes))]


def created(root: Path, features: Mapping[str, Feature] = STATE) -> NpzDatasetWriter:
    writer = NpzDatasetWriter()
    writer.create(root, 30.0, features, {"robot_type": "so101_follower"})
    return writer


def saved(root: Path) -> Path:
    """A dataset of one episode; returns the episode's file."""
    writer = created(root)
    writer.add_frame({"state": np.zeros(2)}, "wave")
    writer.save_episode()
    return root / "episode_000000.npz"


def test_the_reader_gives_back_what_describes_the_dataset(tmp_path):
    features = {
        **STATE,
        "camera": Feature("image", (2, 3, 3)),
        "file": Feature("bool", (1,)),
        "a/b": Feature("int64", ()),
    }
    writer = created(tmp_path, features)
    image = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    for task in ("wave", "wave “again”"):
        writer.add_frame(
            {"state": np.zeros(2), "camera": image, "file": np.array([True]), "a/b": np.array(2**40)}, task
        )
    writer.save_episode()
    dataset = read_npz(tmp_path)
    assert (dataset.fps, dataset.features, dataset.metadata) == (30.0, features, {"robot_type": "so101_follower"})
    episode = dataset.episode(0)
    assert episode["task"].tolist() == ["wave", "wave “again”"]
    assert episode["state"].dtype == np.float32
    assert episode["a/b"].tolist() == [2**40, 2**40]
    np.testing.assert_array_equal(episode["camera"], [image, image])


def test_numpy_reads_an_episode_without_pickles(tmp_path):
    with np.load(saved(tmp_path), allow_pickle=False) as archive:
        assert sorted(archive.files) == ["state", "task"]


def test_values_of_another_kind_are_refused(tmp_path):
    writer = created(tmp_path, {"count": Feature("int64", ()), "state": Feature("float32", (1,))})
    with pytest.raises(DatasetError, match="count has dtype float64, must be int64"):
        writer.add_frame({"count": np.array(1.5), "state": np.zeros(1)}, "wave")
    with pytest.raises(DatasetError, match="state has dtype object, must be float32"):
        writer.add_frame({"count": np.array(1), "state": np.array([None])}, "wave")


@pytest.mark.parametrize(
    ("key", "dtype", "message"),
    [
        ("task", "float32", "no feature may be named 'task'"),
        ("state", "object", "feature 'state' has dtype 'object', must be bool, integer, float or image"),
        ("state", "floaty", "feature 'state' has dtype 'floaty', must be a NumPy type or image"),
    ],
)
def test_features_that_cannot_be_stored_are_refused(tmp_path, key, dtype, message):
    with pytest.raises(DatasetError, match=message):
        created(tmp_path / "set", {key: Feature(dtype, (1,))})
    assert not (tmp_path / "set").exists()


def test_metadata_without_json_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="metadata cannot be written as JSON"):
        NpzDatasetWriter().create(tmp_path / "set", 30.0, STATE, {"path": tmp_path})
    assert not (tmp_path / "set").exists()


def test_a_failed_save_leaves_no_part_of_a_file_and_can_be_repeated(tmp_path, monkeypatch):
    writer = created(tmp_path)
    writer.add_frame({"state": np.ones(2)}, "wave")

    def full(*_args: object, **_options: object) -> None:
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np.lib.format, "write_array", full)
        with pytest.raises(DatasetError, match=r"episode_000000\.npz: No space left"):
            writer.save_episode()
    assert [p.name for p in tmp_path.iterdir()] == ["meta.json"]
    assert writer.save_episode() == 0
    np.testing.assert_array_equal(read_npz(tmp_path).episode(0)["state"], [[1, 1]])


def test_nothing_is_taken_after_finalize(tmp_path):
    writer = created(tmp_path)
    writer.finalize()
    with pytest.raises(DatasetError, match="call create first"):
        writer.add_frame({"state": np.zeros(2)}, "wave")


def test_missing_episode_is_named_in_error(tmp_path):
    saved(tmp_path)
    for index in (1, -1):
        with pytest.raises(DatasetError, match=f"no episode {index} in .*; it has 1"):
            read_npz(tmp_path).episode(index)


def test_a_damaged_episode_is_refused_wherever_it_was_cut(tmp_path):
    path = saved(tmp_path)
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(DatasetError, match="episode_000000"):
            read_npz(tmp_path).episode(0)


def test_an_episode_of_another_dataset_is_refused(tmp_path):
    np.savez(saved(tmp_path), state=np.zeros((1, 2)))
    with pytest.raises(DatasetError, match="has state, must have state, task"):
        read_npz(tmp_path).episode(0)


@pytest.mark.parametrize("content", ["", "{}", "[]", json.dumps({"fps": 1, "features": {"a": {}}, "metadata": {}})])
def test_a_directory_without_a_dataset_is_refused(tmp_path, content):
    (tmp_path / "meta.json").write_text(content)
    with pytest.raises(DatasetError, match="is not an npz dataset"):
        read_npz(tmp_path)


def test_the_hook_offers_the_writer():
    (descriptor,) = ibrobot_datasets()
    assert isinstance(descriptor.make(descriptor.options(), host_context()), NpzDatasetWriter)
