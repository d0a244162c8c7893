"""The dataset writer: the conformance suite, and what is on disk."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, override

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from ibrobot_lerobot import ibrobot_datasets
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.video import choose_encoder
from ibrobot_lerobot.writer import LeRobotDatasetWriter
from ibrobot_provenance.dataset_suite import DatasetSuite
from numpy.typing import NDArray

from ibrobot_core.api import Context, DatasetError, Feature

from .conftest import CAMERA, STATE, check, picture, rows, values, write


class TestLeRobotDatasetWriter(DatasetSuite):
    @override
    def make(self, ctx: Context) -> LeRobotDatasetWriter:
        [descriptor] = ibrobot_datasets()
        writer = descriptor.make(LeRobotOptions(), ctx)
        assert isinstance(writer, LeRobotDatasetWriter)
        return writer

    @override
    def read_back(self, root: Path) -> Sequence[Mapping[str, NDArray[np.generic]]]:
        saved = sorted(p for p in (root / ".episodes").glob("*") if not p.suffix)
        return [frames for path in (saved or [root]) for frames in tables(path)]

    @override
    def read_tasks(self, root: Path) -> Sequence[Sequence[str]]:
        names = {row["task_index"]: row["task"] for row in pq.read_table(root / "meta/tasks.parquet").to_pylist()}
        return [[names[int(index)] for index in episode["task_index"]] for episode in self.read_back(root)]


def tables(root: Path) -> list[dict[str, NDArray[Any]]]:
    """The episodes of a dataset: column -> rows."""
    found = rows(root)
    return [
        {key: np.array([row[key] for row in found if row["episode_index"] == episode], np.float32) for key in found[0]}
        for episode in sorted({row["episode_index"] for row in found})
    ]


@pytest.mark.parametrize("options", [{}, {"codec": "h264", "gop": 12}, {"codec": "hevc", "threads": 2}])
def test_videos_keep_step_with_their_rows(tmp_path: Path, options: dict[str, Any]) -> None:
    features = {"observation.state": STATE, "observation.images.top": CAMERA, "observation.images.wrist": CAMERA}
    root = write(tmp_path / "set", features, (7, 1, 12), crf=20, **options)
    check(root, features, (7, 1, 12))


def test_pictures_in_tables_are_exact(tmp_path: Path) -> None:
    features = {
        "observation.images.top": CAMERA,
        "observation.images.grey": Feature("image", (32, 64, 1)),
        "observation.images.depth": Feature("uint16", (4, 6, 1)),
        "observation.images.far": Feature("float32", (5, 3, 1)),
    }
    root = write(tmp_path / "set", features, (3,), videos=False)
    info = json.loads((root / "meta/info.json").read_text())["features"]
    assert {key: info[key]["dtype"] for key in features} == dict.fromkeys(features, "image")
    assert info["observation.images.depth"]["info"] == {"is_depth_map": True, "depth_unit": "mm"}
    assert info["observation.images.far"]["info"] == {"is_depth_map": True, "depth_unit": "m"}
    for number, row in enumerate(rows(root)):
        wanted = values(features, number)
        for key in list(features)[:3]:
            np.testing.assert_array_equal(opened(row[key]["bytes"]), wanted[key])
        # FFmpeg reads no TIFF of floats: the pixels are the one strip from byte 8 on.
        pixels = np.frombuffer(row["observation.images.far"]["bytes"], "<f4", 15, 8).reshape(5, 3, 1)
        np.testing.assert_array_equal(pixels, wanted["observation.images.far"])


def opened(content: bytes) -> NDArray[Any]:
    """A picture file's pixels, shape (H, W, C), by FFmpeg."""
    with av.open(BytesIO(content), "r") as container:
        [frame] = container.decode(video=0)
        pixels = frame.to_ndarray()
    return pixels if pixels.ndim == 3 else pixels[..., None]


def test_statistics_are_those_of_the_frames(tmp_path: Path) -> None:
    features = {"observation.state": STATE, "observation.images.top": CAMERA}
    root = write(tmp_path / "set", features, (6, 9), videos=False)
    stats = json.loads((root / "meta/stats.json").read_text())
    every = [values(features, number) for number in range(15)]
    vectors = np.stack([each["observation.state"] for each in every]).astype(np.float64)
    pixels = np.stack([each["observation.images.top"] for each in every]) / 255
    for name in ("min", "max", "mean", "std"):
        exact = getattr(vectors, name)(0)
        np.testing.assert_allclose(stats["observation.state"][name], exact, atol=1e-9)
        np.testing.assert_allclose(
            np.array(stats["observation.images.top"][name])[:, 0, 0], getattr(pixels, name)((0, 1, 2)), atol=1e-9
        )
    assert stats["observation.state"]["count"] == stats["observation.images.top"]["count"] == [15]
    assert stats["index"]["max"] == [14.0]
    assert np.all(np.array(stats["observation.state"]["q01"]) < stats["observation.state"]["q99"])


def test_tasks_are_numbered_as_they_come(tmp_path: Path) -> None:
    root = write(tmp_path / "set", {"observation.state": STATE}, (2, 2, 2))
    assert pq.read_table(root / "meta/tasks.parquet").to_pylist() == [
        {"task_index": 0, "task": "task 0"},
        {"task_index": 1, "task": "task 1"},
    ]
    assert [row["task_index"] for row in rows(root)] == [0, 0, 1, 1, 0, 0]
    described = json.loads(pq.read_schema(root / "meta/tasks.parquet").metadata[b"pandas"])
    assert described["index_columns"] == ["task"]


def test_memory_does_not_hold_a_table_of_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_lerobot.episode._ROWS_BYTES", 500)
    root = write(tmp_path / "set", {"observation.images.top": CAMERA}, (8,), videos=False)
    assert pq.ParquetFile(root / "data/chunk-000/file-000.parquet").num_row_groups > 3
    assert [row["frame_index"] for row in rows(root)] == list(range(8))


@pytest.mark.parametrize(
    ("key", "feature", "message"),
    [
        ("timestamp", STATE, "the name is reserved by LeRobot"),
        ("a/b", STATE, "contains a slash"),
        ("x", Feature("image", (-1, -1, 3)), "at least 1"),
        ("x", Feature("float32", (2, 2)), "neither a vector nor an image"),
        ("x", Feature("complex64", (2,)), "neither a vector nor an image"),
    ],
)
def test_refuses_features_without_a_place(tmp_path: Path, key: str, feature: Feature, message: str) -> None:
    writer = LeRobotDatasetWriter(LeRobotOptions())
    with pytest.raises(DatasetError, match=message):
        writer.create(tmp_path / "set", 30.0, {key: feature}, {})
    assert not (tmp_path / "set").exists()


def test_refuses_a_rate_that_lerobot_cannot_have(tmp_path: Path) -> None:
    writer = LeRobotDatasetWriter(LeRobotOptions())
    with pytest.raises(DatasetError, match=r"whole number of frames per second; contract.rate_hz is 12.5"):
        writer.create(tmp_path / "set", 12.5, {"observation.state": STATE}, {})


def test_an_encoder_that_does_not_open_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "ibrobot_lerobot.video._opens", lambda encoder: "no device" if "nvenc" in encoder.codec else None
    )
    with pytest.raises(DatasetError, match="h264_nvenc is not available: no device"):
        choose_encoder(LeRobotOptions(codec="h264_nvenc"))


def test_auto_takes_the_first_gpu_encoder_that_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "ibrobot_lerobot.video._opens", lambda encoder: None if "hevc" in encoder.codec else "no device"
    )
    assert choose_encoder(LeRobotOptions(codec="auto")).codec == "hevc_nvenc"
    monkeypatch.setattr("ibrobot_lerobot.video._opens", lambda encoder: "no device")
    assert choose_encoder(LeRobotOptions(codec="auto")).codec == "libsvtav1"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="libsvtav1 raises priorities as root only")
def test_encoding_takes_no_priority_over_the_control_loop(tmp_path: Path) -> None:
    writer = LeRobotDatasetWriter(LeRobotOptions())
    writer.create(tmp_path / "set", 30.0, {"observation.images.top": CAMERA}, {})
    for number in range(12):  # more than can wait, so that the encoder is open
        writer.add_frame({"observation.images.top": picture(number)}, "task")
    assert os.SCHED_FIFO not in {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}
    writer.save_episode()
    writer.finalize()


def test_a_full_disk_is_reported_and_no_thread_waits(tmp_path: Path) -> None:
    features = {"observation.images.top": CAMERA}
    writer = LeRobotDatasetWriter(LeRobotOptions())
    writer.create(tmp_path / "set", 30.0, features, {})
    writer.add_frame({"observation.images.top": picture(0)}, "task")
    assert writer._open is not None
    [track] = writer._open._tracks.values()
    track._failure = OSError("No space left on device")
    with pytest.raises(DatasetError, match="No space left on device"):
        writer.add_frame({"observation.images.top": picture(1)}, "task")
    writer.finalize()
    assert not (tmp_path / "set/meta").exists()


@pytest.mark.parametrize("codec", ["h264", "hevc", "libsvtav1"])
def test_sizes_that_an_encoder_cannot_encode_are_refused_before_it_begins(tmp_path: Path, codec: str) -> None:
    features = {"observation.images.top": Feature("image", (65, 97, 3))}
    writer = LeRobotDatasetWriter(LeRobotOptions(codec=codec))
    if codec != "libsvtav1":
        with pytest.raises(
            DatasetError, match=f"codec {codec} cannot encode images of 97x65: it needs even sizes; use libs"
        ):
            writer.create(tmp_path / "set", 30, features, {})
        assert not (tmp_path / "set").exists()
        return
    writer.create(tmp_path / "set", 30, features, {})
    for _ in range(3):
        writer.add_frame({"observation.images.top": np.zeros((65, 97, 3), np.uint8)}, "look")
    writer.save_episode()
    writer.finalize()
    assert len(rows(tmp_path / "set")) == 3
