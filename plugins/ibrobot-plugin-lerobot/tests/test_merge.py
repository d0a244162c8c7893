"""Merging datasets: numbers, videos, files of limited size, appending, crashes."""

from __future__ import annotations

import json
import os
import shutil
import threading
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from ibrobot_lerobot import merge as merging
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from ibrobot_provenance.ownership import InUse

from ibrobot_core.api import DatasetError, Feature

from .conftest import CAMERA, FPS, STATE, check, episodes, rows, values, write

FEATURES = {"observation.state": STATE, "observation.images.top": CAMERA}


def parts(
    folder: Path, lengths: tuple[int, ...], features: dict[str, Feature] = FEATURES, **options: Any
) -> list[Path]:
    """Datasets of one episode each, whose frames are counted through."""
    number, found = 0, []
    for i, length in enumerate(lengths):
        writer = LeRobotDatasetWriter(LeRobotOptions(**options))
        writer.create(folder / str(i), FPS, features, {"robot_type": "tester"})
        for _ in range(length):
            writer.add_frame(values(features, number), f"task {i % 2}")
            number += 1
        writer.save_episode()
        writer.finalize()
        found.append(folder / str(i))
    return found


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_equal_parts_give_equal_bytes(tmp_path: Path) -> None:
    once, again = parts(tmp_path / "a", (5, 3)), parts(tmp_path / "b", (5, 3))
    merging.merge(tmp_path / "one", once, {"name": "x"})
    merging.merge(tmp_path / "two", again, {"name": "x"})
    assert content(tmp_path / "one") == content(tmp_path / "two")


def test_a_writer_of_many_episodes_gives_what_a_merge_gives(tmp_path: Path) -> None:
    merging.merge(tmp_path / "merged", parts(tmp_path / "parts", (5, 3)), {"robot_type": "tester"})
    assert content(tmp_path / "merged") == content(write(tmp_path / "written", FEATURES, (5, 3)))


def test_files_have_a_limited_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = parts(tmp_path / "parts", (6, 4, 5, 2), crf=10)
    monkeypatch.setattr(merging, "_MIB", 1)  # limits in bytes
    table = (found[0] / "data/chunk-000/file-000.parquet").stat().st_size
    video = (found[0] / "videos/observation.images.top/chunk-000/file-000.mp4").stat().st_size
    for path in found:
        info = json.loads((path / "meta/info.json").read_text())
        info |= {"data_files_size_in_mb": table + 10, "video_files_size_in_mb": 2 * video}
        (path / "meta/info.json").write_text(json.dumps(info))
    merging.merge(tmp_path / "set", found, {})
    assert len(list((tmp_path / "set/data").rglob("*.parquet"))) == 4
    assert 1 < len(list((tmp_path / "set/videos").rglob("*.mp4"))) < 4
    check(tmp_path / "set", FEATURES, (6, 4, 5, 2))


def test_appending_leaves_the_old_files_alone(tmp_path: Path) -> None:
    first, *rest = parts(tmp_path / "parts", (5, 3, 4))
    root = tmp_path / "set"
    merging.merge(root, [first], {"n": 1})
    before = content(root)
    merging.merge(root, rest, {"n": 2})
    after = content(root)
    changed = {name for name in before if after[name] != before[name]}
    meta = ("info.json", "stats.json", "tasks.parquet", "ibrobot.json", "ibrobot_pixels.json")
    assert changed == {f"meta/{name}" for name in meta}
    check(root, FEATURES, (5, 3, 4))
    writer = LeRobotDatasetWriter(LeRobotOptions())
    summary = writer.summary(root)
    assert summary is not None
    assert (summary.episodes, summary.frames, summary.metadata) == (3, 12, {"n": 2})
    assert dict(summary.features) == FEATURES
    assert pq.read_table(root / "meta/tasks.parquet").column("task").to_pylist() == ["task 0", "task 1"]


def test_a_merged_dataset_can_be_a_part(tmp_path: Path) -> None:
    found = parts(tmp_path / "parts", (4, 2, 3))
    merging.merge(tmp_path / "two", found[:2], {})
    merging.merge(tmp_path / "three", [tmp_path / "two", found[2]], {})
    check(tmp_path / "three", FEATURES, (4, 2, 3))


@pytest.mark.parametrize(
    ("features", "options", "message"),
    [
        ({"observation.state": STATE}, {}, "observation.images.top None"),
        (FEATURES, {"videos": False}, "'dtype': 'image'"),
        (FEATURES, {"codec": "h264"}, "'video.codec': 'h264'"),
    ],
)
def test_a_part_that_does_not_fit_changes_nothing(
    tmp_path: Path, features: dict[str, Feature], options: dict[str, Any], message: str
) -> None:
    merging.merge(tmp_path / "set", parts(tmp_path / "a", (2,)), {})
    before = content(tmp_path / "set")
    with pytest.raises(DatasetError, match="does not fit: its features are") as caught:
        merging.merge(tmp_path / "set", parts(tmp_path / "b", (2,), features, **options), {})
    assert message in str(caught.value)
    assert content(tmp_path / "set") == before


def test_a_video_that_lacks_pictures_is_refused(tmp_path: Path) -> None:
    one, two = parts(tmp_path / "parts", (4, 3))
    video = "videos/observation.images.top/chunk-000/file-000.mp4"
    shutil.copy(one / video, two / video)
    with pytest.raises(DatasetError, match="has 4 images, its table 3 rows"):
        merging.merge(tmp_path / "set", [one, two], {})
    assert not (tmp_path / "set/meta").exists()


def test_an_interrupted_merge_is_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = parts(tmp_path / "parts", (4, 3))
    root = tmp_path / "set"
    merging.merge(root, [first], {})
    moves = 0

    def killed(self: Path, target: Path) -> Path:
        nonlocal moves
        moves += 1
        if moves == 3:
            raise KeyboardInterrupt
        return real(self, target)

    real = Path.replace
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            merging.merge(root, [second], {})
    assert json.loads((root / "meta/info.json").read_text())["total_episodes"] == 1
    summary = LeRobotDatasetWriter(LeRobotOptions()).summary(root)
    assert summary is not None
    assert summary.episodes == 2
    check(root, FEATURES, (4, 3))
    assert not list(root.glob(".*"))


def test_a_merge_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    found = parts(tmp_path / "parts", (4, 3))
    monkeypatch.setattr(merging, "join_videos", full)
    with pytest.raises(DatasetError, match="No space left on device"):
        merging.merge(tmp_path / "set", found, {})
    assert list((tmp_path / "set").iterdir()) == []


def test_statistics_of_episodes_have_their_places(tmp_path: Path) -> None:
    merging.merge(tmp_path / "set", parts(tmp_path / "parts", (4, 3)), {})
    second = episodes(tmp_path / "set")[1]
    assert second["stats/index/min"] == [4.0]
    assert second["stats/episode_index/mean"] == [1.0]
    assert second["stats/task_index/max"] == [1.0]


def test_merges_at_once_lose_no_episode_and_double_none(tmp_path: Path) -> None:
    found = parts(tmp_path / "parts", (5, 3, 4, 2), {"observation.state": STATE})
    threads = [threading.Thread(target=merging.merge, args=(tmp_path / "set", [part], {})) for part in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    there = episodes(tmp_path / "set")
    assert sorted(row["length"] for row in there) == [2, 3, 4, 5]
    assert [row["index"] for row in rows(tmp_path / "set")] == list(range(14))
    assert not list((tmp_path / "set").glob(".*"))


def test_nobody_completes_a_merge_that_another_process_is_completing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = parts(tmp_path / "parts", (4, 3), {"observation.state": STATE})
    root = tmp_path / "set"
    merging.merge(root, [first], {})
    real, refused = Path.replace, []

    def beside(self: Path, target: Path) -> Path:
        """Another process looks at the dataset between the moves of two files."""
        with pytest.raises(InUse, match=f"is being merged by process {os.getpid()}") as caught:
            LeRobotDatasetWriter(LeRobotOptions()).summary(root)
        refused.append(caught.value)
        return real(self, target)

    monkeypatch.setattr(merging, "_WAIT_S", 0.0)
    monkeypatch.setattr(Path, "replace", beside)
    merging.merge(root, [second], {})
    assert len(refused) > 3
    assert [row["length"] for row in episodes(root)] == [4, 3]


def test_what_was_merged_is_on_the_disk_before_the_parts_may_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (part,) = parts(tmp_path / "parts", (4,))
    synced: set[int] = set()
    real_sync, real_rename, real_remove = os.fsync, Path.rename, shutil.rmtree

    def sync(descriptor: int) -> None:
        synced.add(os.fstat(descriptor).st_ino)
        real_sync(descriptor)

    def rename(self: Path, target: Path) -> Path:
        if self.name == ".merging":
            assert {path.stat().st_ino for path in self.rglob("*")} <= synced, "before it counts as merged"
            synced.clear()
        return real_rename(self, target)

    def remove(path: Path, **more: Any) -> None:
        if path.name == ".merged":
            folders = {path.parent, *(each.parent for each in content_paths(path.parent))}
            assert {folder.stat().st_ino for folder in folders} <= synced, "their new names, too"
        real_remove(path, **more)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(Path, "rename", rename)
    monkeypatch.setattr(shutil, "rmtree", remove)
    merging.merge(tmp_path / "set", [part], {})
    check(tmp_path / "set", FEATURES, (4,))


def content_paths(root: Path) -> list[Path]:
    """The files of a dataset, hidden ones left out."""
    return [path for path in root.rglob("*") if path.is_file() and "/." not in str(path.relative_to(root.parent))]
