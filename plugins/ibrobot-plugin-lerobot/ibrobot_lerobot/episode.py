"""Writes one episode as a separate LeRobot dataset, for merging."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError
from ibrobot_lerobot import layout
from ibrobot_lerobot.arrow import table_of, to_array
from ibrobot_lerobot.layout import Column
from ibrobot_lerobot.pictures import PngEncoder, tiff
from ibrobot_lerobot.stats import PictureStats, Stats, picture_stats, vector_stats
from ibrobot_lerobot.video import Encoder, VideoTrack, describe_video

_ROWS_BYTES = 16 << 20
_ROWS = 1 << 13
"""Number of rows to write at a time, so that memory does not grow with the length of an episode."""


@attrs.frozen
class Format:
    """Properties shared by all episodes of a dataset."""

    stored: Mapping[str, Column]
    fps: int
    encoder: Encoder | None
    """None without videos."""
    info: Mapping[str, Any]
    """`info.json` of an empty dataset."""


class EpisodeWriter:
    """Writes the frames of one episode.

    Args:
        root: folder of the new dataset, which must not exist.
        form: properties shared by all episodes.
        metadata: content of `meta/ibrobot.json`.
    """

    def __init__(self, root: Path, form: Format, metadata: Mapping[str, Any]) -> None:
        self._root = root
        self._form = form
        self._metadata = metadata
        self.frames = 0
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._rows_bytes = 0
        self._vectors: dict[str, list[NDArray[Any]]] = {"task_index": []}
        """Written blocks of rows, for statistics."""
        self._pictures: dict[str, tuple[Any, PictureStats]] = {}
        self._tracks: dict[str, VideoTrack] = {}
        path = root / layout.chunk_file(layout.DATA, 0, "parquet")
        path.parent.mkdir(parents=True)
        self._schema = layout.table_schema(form.stored)
        self._table = pq.ParquetWriter(path, self._schema, compression="snappy")
        try:
            for column in form.stored.values():
                self._prepare(column)
        except BaseException:
            self.abort()
            raise

    def _prepare(self, column: Column) -> None:
        shape = column.feature.shape
        if column.storage == "video":
            assert self._form.encoder is not None
            path = self._video(column.key)
            path.parent.mkdir(parents=True)
            self._tracks[column.key] = VideoTrack(path, self._form.fps, shape, self._form.encoder)
        elif column.storage == "image":
            self._pictures[column.key] = (PngEncoder(*shape), picture_stats(column.feature))
        elif column.storage == "depth":
            self._pictures[column.key] = (tiff, picture_stats(column.feature))
        else:
            self._vectors[column.key] = []

    def _video(self, key: str) -> Path:
        return self._root / layout.chunk_file(f"{layout.VIDEOS}/{key}", 0, "mp4")

    def add(self, values: Mapping[str, NDArray[Any]], task: str) -> None:
        """Append a frame with checked values.

        Raises:
            DatasetError: if it cannot be encoded or written.
        """
        number = self._tasks.setdefault(task, len(self._tasks))
        row: dict[str, Any] = {
            "timestamp": self.frames / self._form.fps,
            "frame_index": self.frames,
            "episode_index": 0,
            "index": self.frames,
            "task_index": number,
        }
        for key, track in self._tracks.items():
            track.add(values[key])
        for key, (encode, stats) in self._pictures.items():
            suffix = "png" if isinstance(encode, PngEncoder) else "tiff"
            content = encode(values[key])
            row[key] = {"bytes": content, "path": f"frame-{self.frames:06d}.{suffix}"}
            self._rows_bytes += len(content)
            stats.add(values[key])
        row |= {key: values[key].copy() for key in self._vectors if key in values}
        self._rows.append(row)
        self.frames += 1
        if self._rows_bytes >= _ROWS_BYTES or len(self._rows) >= _ROWS:
            self._flush()

    def _flush(self) -> None:
        arrays = [self._array(field) for field in self._schema]
        try:
            self._table.write_table(pa.Table.from_arrays(arrays, schema=self._schema))
        except OSError as error:
            raise DatasetError(f"{self._root}: cannot be written: {error}") from error
        self._rows, self._rows_bytes = [], 0

    def _array(self, field: pa.Field) -> pa.Array:
        values: Any = [row[field.name] for row in self._rows]
        if field.name in self._vectors:
            values = np.array(values)
            self._vectors[field.name].append(values)
        return to_array(values, field.type)

    def close(self) -> None:
        """Finish the episode, so that LeRobot can load the dataset.

        Raises:
            DatasetError: if it cannot be written.
        """
        try:
            if self._rows:
                self._flush()
            self._table.close()
            videos = {key: track.close() for key, track in self._tracks.items()}
            self._write_meta({**videos, **{key: pixels for key, (_, pixels) in self._pictures.items()}})
        except OSError as error:
            raise DatasetError(f"{self._root}: cannot be written: {error}") from error
        finally:
            self.abort()

    def abort(self) -> None:
        """Release all resources; the written files are unusable unless `close` succeeded."""
        for track in self._tracks.values():
            track.abort()
        self._table.close()

    def _write_meta(self, pictures: Mapping[str, PictureStats]) -> None:
        form, n = self._form, self.frames
        vectors = {key: np.concatenate(blocks) for key, blocks in self._vectors.items()}
        stats = {key: vector_stats(values) for key, values in vectors.items() if key in form.stored}
        stats |= {key: pixels.stats() for key, pixels in pictures.items()}
        stats = {key: stats[key] for key in form.stored} | counter_stats(n, form.fps, 0, 0, vectors["task_index"])
        info = {**form.info, "features": {key: dict(entry) for key, entry in form.info["features"].items()}}
        for key in self._tracks:
            assert form.encoder is not None
            info["features"][key]["info"] = describe_video(self._video(key), form.fps, form.encoder)
        row: dict[str, Any] = {
            "episode_index": 0, "tasks": list(self._tasks), "length": n, "data/chunk_index": 0, "data/file_index": 0,
            "dataset_from_index": 0, "dataset_to_index": n,
        }  # fmt: skip
        for key in self._tracks:
            place = {"chunk_index": 0, "file_index": 0, "from_timestamp": 0.0, "to_timestamp": n / form.fps}
            row |= {f"videos/{key}/{name}": value for name, value in place.items()}
        row |= stats_columns(stats) | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        path = self._root / layout.chunk_file(layout.EPISODES, 0, "parquet")
        path.parent.mkdir(parents=True)
        pq.write_table(table_of([row]), path)
        write_meta(self._root, info, 1, n, list(self._tasks), stats, pictures, self._metadata)


def write_meta(
    root: Path, info: Mapping[str, Any], episodes: int, frames: int, tasks: list[str], stats: Mapping[str, Stats],
    pictures: Mapping[str, PictureStats], metadata: Mapping[str, Any],
) -> None:  # fmt: skip
    """Write what `meta` has besides the rows of the episodes; `info.json`, which marks a dataset, comes last."""
    totals = {"total_episodes": episodes, "total_frames": frames, "total_tasks": len(tasks)}
    values = {key: {name: value.tolist() for name, value in each.items()} for key, each in stats.items()}
    pq.write_table(layout.task_table(tasks), root / layout.TASKS)
    layout.write_json(root / layout.STATS, values)
    if pictures:
        layout.write_json(root / layout.PIXELS, {key: each.state() for key, each in pictures.items()})
    layout.write_json(root / layout.OWN, metadata)
    layout.write_json(root / layout.INFO, {**info, **totals, "splits": {"train": f"0:{episodes}"}})


def stats_columns(stats: Mapping[str, Stats]) -> dict[str, Any]:
    """The statistics of an episode in its row."""
    return {f"stats/{key}/{name}": value.tolist() for key, each in stats.items() for name, value in each.items()}


def counter_stats(frames: int, fps: int, begin: int, episode: int, task_numbers: NDArray[Any]) -> dict[str, Stats]:
    """Statistics of the columns that the writer generates."""
    index = np.arange(frames)
    values_of = {
        "timestamp": index / fps,
        "frame_index": index,
        "episode_index": np.full(frames, episode),
        "index": index + begin,
        "task_index": task_numbers,
    }
    return {key: vector_stats(values[:, None]) for key, values in values_of.items()}
