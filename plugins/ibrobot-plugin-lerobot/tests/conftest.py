"""What the tests of LeRobot datasets share: pictures, a writer, and independent readers of what is on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from numpy.typing import NDArray

from ibrobot_core.api import Feature

FPS = 30
STATE = Feature("float32", (3,), ("a", "b", "c"))
CAMERA = Feature("image", (64, 96, 3), ("height", "width", "channels"))


def picture(number: int, shape: tuple[int, ...] = (64, 96, 3)) -> NDArray[np.uint8]:
    """Blocks that are others for each number: two different pictures differ by about 0.37 of full scale."""
    blocks = np.random.default_rng(number).choice(
        np.array([30, 220], np.uint8), (shape[0] // 32, shape[1] // 32, shape[2])
    )
    return blocks.repeat(32, 0).repeat(32, 1)


def write(
    root: Path, features: dict[str, Feature], lengths: tuple[int, ...], begin: int = 0, task: int = 0, **options: Any
) -> Path:
    """A dataset whose frame i has `values(features, begin + i)`, counted through all episodes."""
    writer = LeRobotDatasetWriter(LeRobotOptions(**options))
    writer.create(root, FPS, features, {"robot_type": "tester"})
    number = begin
    for episode, length in enumerate(lengths, task):
        for _ in range(length):
            writer.add_frame(values(features, number), f"task {episode % 2}")
            number += 1
        writer.save_episode()
    writer.finalize()
    return root


def values(features: dict[str, Feature], number: int) -> dict[str, NDArray[Any]]:
    """What frame `number` has."""
    found: dict[str, NDArray[Any]] = {}
    for i, (key, feature) in enumerate(features.items()):
        if feature.dtype == "image":
            found[key] = picture(1000 * i + number, feature.shape)
        elif len(feature.shape) == 3:
            rng = np.random.default_rng(number)
            found[key] = (rng.random(feature.shape) * 3000).astype(feature.dtype)
        else:
            found[key] = np.random.default_rng(number).normal(size=feature.shape).astype(feature.dtype)
    return found


def rows(root: Path) -> list[dict[str, Any]]:
    """All rows of the data tables, in order of files."""
    return [row for path in sorted(root.glob("data/*/*.parquet")) for row in pq.read_table(path).to_pylist()]


def episodes(root: Path) -> list[dict[str, Any]]:
    """All rows of `meta/episodes`."""
    return [row for path in sorted(root.glob("meta/episodes/*/*.parquet")) for row in pq.read_table(path).to_pylist()]


def shown(root: Path, key: str, episode: int) -> list[NDArray[Any]]:
    """The pictures of an episode, found as LeRobot does: by file and time."""
    row = episodes(root)[episode]
    chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
    with av.open(str(root / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4")) as container:
        frames = {
            round(float(frame.time) * FPS): frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)
        }
    begin = round(row[f"videos/{key}/from_timestamp"] * FPS)
    assert round(row[f"videos/{key}/to_timestamp"] * FPS) == begin + row["length"]
    return [frames[begin + i] for i in range(row["length"])]


def check(root: Path, features: dict[str, Feature], lengths: tuple[int, ...]) -> None:
    """Check that a dataset has what `write` was given."""
    found, number = rows(root), 0
    assert [row["length"] for row in episodes(root)] == list(lengths)
    assert [row["index"] for row in found] == list(range(sum(lengths)))
    videos = [key for key, feature in features.items() if feature.dtype == "image" and feature.shape[2] == 3]
    vectors = [key for key, feature in features.items() if len(feature.shape) == 1]
    for episode, length in enumerate(lengths):
        row = episodes(root)[episode]
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (number, number + length)
        pictures = {key: shown(root, key, episode) for key in videos}
        for i in range(length):
            here, wanted = found[number], values(features, number)
            assert (here["episode_index"], here["frame_index"]) == (episode, i)
            assert here["timestamp"] == pytest.approx(i / FPS)
            for key in vectors:
                np.testing.assert_array_equal(np.array(here[key], np.float32), wanted[key])
            for key in videos:
                assert np.abs(pictures[key][i].astype(float) - wanted[key]).mean() < 0.15 * 255
            number += 1
