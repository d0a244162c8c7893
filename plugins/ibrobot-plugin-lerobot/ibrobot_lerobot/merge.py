"""Merges datasets atomically: renumbers tables and joins videos without re-encoding."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from ibrobot_provenance.files import sync
from ibrobot_provenance.ownership import Ownership, owned

from ibrobot_core.api import DatasetError
from ibrobot_lerobot import layout
from ibrobot_lerobot.arrow import table_of, to_array, to_numpy
from ibrobot_lerobot.episode import counter_stats, stats_columns, write_meta
from ibrobot_lerobot.layout import OnDisk
from ibrobot_lerobot.plausible import is_content
from ibrobot_lerobot.rows import EpisodeRows
from ibrobot_lerobot.stats import QUANTILES, PictureStats, Stats, picture_stats, vector_stats
from ibrobot_lerobot.video import join_videos

_MERGING = ".merging"
"""Folder of a merge in progress; discarded after an interruption."""
_MERGED = ".merged"
"""Folder of a complete merge, whose files only need to be moved."""
_LOCK = ".merge.lock"
_WAIT_S = 10.0
"""How long to wait for another process that merges [s]."""
_EPISODES_AT_ONCE = 64
_MIB = 1 << 20
_STATISTICS = {"min", "max", "mean", "std", "count", *QUANTILES}
"""What an episode's statistics have, for every feature."""


def complete(root: Path) -> None:
    """Finish a merge that was interrupted while its files were moved.

    Raises:
        InUse: if another process keeps merging into the dataset.
        DatasetError: if a file cannot be moved.
    """
    if (root / _MERGED).is_dir():
        with _owning(root):
            _complete(root)


def adopt(root: Path, part: Path) -> None:
    """Move the dataset `part`, in a folder below `root`, to `root`, which has no dataset yet.

    Raises:
        InUse: if another process merges into the dataset.
        DatasetError: if a file cannot be moved.
    """
    with _owning(root):
        try:
            part.rename(root / _MERGED)
        except OSError as error:
            raise DatasetError(f"{part}: cannot be moved: {error}") from error
        _complete(root)


def merge(root: Path, parts: Sequence[Path], metadata: Mapping[str, Any]) -> None:
    """Append the episodes of `parts` to the dataset at `root`; see `DatasetWriter.merge`."""
    if not parts:
        raise DatasetError(f"{root}: nothing to merge")
    with _owning(root):
        _complete(root)
        old = layout.open_dataset(root)
        merging = root / _MERGING
        try:
            shutil.rmtree(merging, ignore_errors=True)
            merging.mkdir()
            _Merge(merging, old).run(parts, metadata)
            for path in (merging, *merging.rglob("*")):
                sync(path)  # the parts may be deleted afterwards
            merging.rename(root / _MERGED)
        except (OSError, pa.ArrowException) as error:
            raise DatasetError(f"{root}: cannot be merged: {error}") from error
        finally:
            shutil.rmtree(merging, ignore_errors=True)
        _complete(root)


@contextmanager
def reading(root: Path, doing: str) -> Iterator[None]:
    """A context in which nobody merges into the dataset; finishes an interrupted merge first.

    Args:
        root: the dataset.
        doing: what is done with it, for others' errors, e.g. `is being trained on`.

    Raises:
        InUse: if another process keeps merging into the dataset.
        DatasetError: if an interrupted merge cannot be finished, or the dataset cannot be locked.
    """
    complete(root)
    with owned(root, doing, DatasetError, file=root / _LOCK, shared=True, wait_s=_WAIT_S):
        yield


def _owning(root: Path) -> Ownership:
    """A context in which no other process merges into the dataset."""
    return owned(root, "is being merged", DatasetError, file=root / _LOCK, wait_s=_WAIT_S)


def _complete(root: Path) -> None:
    merged = root / _MERGED
    if not merged.is_dir():
        return
    try:
        # `info.json` marks a complete dataset, so it comes last.
        files = sorted((p for p in merged.rglob("*") if p.is_file()), key=lambda p: (p == merged / layout.INFO, p))
        folders = {root}
        for path in files:
            target = root / path.relative_to(merged)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
            folders |= {folder for folder in target.parents if folder.is_relative_to(root)}
        for folder in folders:
            sync(folder)
        shutil.rmtree(merged)
    except OSError as error:
        raise DatasetError(f"{root}: the merge cannot be completed: {error}") from error


@attrs.define
class _Place:
    """A growing file: its number, present size and first row."""

    number: int
    bytes: int = 0
    frames: int = 0


class _Merge:
    """A merge into the empty folder `target`, which follows the content of `old`."""

    def __init__(self, target: Path, old: OnDisk | None) -> None:
        self._target = target
        self._old = old
        self._tasks = {task: i for i, task in enumerate(old.tasks)} if old else {}
        self._pictures: dict[str, PictureStats] = {}
        self._episode = old.info["total_episodes"] if old else 0
        self._frame = old.info["total_frames"] if old else 0
        self._table: pq.ParquetWriter | None = None
        self._schema: pa.Schema | None = None
        """That of all tables, which is that of the first one."""
        self._data = _Place(_next(old, layout.DATA, "parquet"))
        self._videos: dict[str, _Place] = {}
        self._joining: dict[str, list[tuple[Path, int]]] = {}
        self._rows: list[dict[str, Any]] = []
        self._rows_table: pq.ParquetWriter | None = None
        self._rows_number = _next(old, layout.EPISODES, "parquet")
        self._info: dict[str, Any] = old.info if old else {}

    def run(self, parts: Iterable[Path], metadata: Mapping[str, Any]) -> None:
        if self._old is not None:
            self._count_known(self._old)
            for row in self._old.episodes() if self._uncounted(self._old) else ():
                self._count_episode(self._old, row)
        try:
            for path in parts:
                part = layout.existing_dataset(path)
                if not part.info["total_episodes"]:
                    raise DatasetError(f"{path}: has no episodes")
                self._check(part)
                self._append(part)
                if len(self._rows) >= _EPISODES_AT_ONCE:
                    self._flush_rows()
            self._flush_rows()
            for key in self._joining:
                self._join(key)
        finally:
            for table in (self._table, self._rows_table):
                if table is not None:
                    table.close()
        episodes, frames, tasks = self._episode, self._frame, list(self._tasks)
        write_meta(self._target, self._info, episodes, frames, tasks, self._stats(), self._pictures, metadata)

    def _check(self, part: OnDisk) -> None:
        """Check that a part is compatible; an empty dataset adopts the first part's description."""
        if not self._info:
            self._info = part.info if part.is_current else layout.current_info(part.info)
        for name, present, wanted in (
            ("fps", part.info["fps"], self._info["fps"]),
            ("features", _stored(part.info), _stored(self._info)),
        ):
            if not _fits(present, wanted):
                raise DatasetError(f"{part.root} does not fit: its {name} are {_difference(present, wanted)}")

    def _append(self, part: OnDisk) -> None:
        self._count_known(part)
        tasks = np.array([self._tasks.setdefault(task, len(self._tasks)) for task in part.tasks], dtype=np.int64)
        data = {path: self._append_table(path, tasks) for path in part.tables()}
        rows = list(part.episodes())
        videos = {key: self._append_videos(part, key, rows) for key in part.videos}
        for row in rows:
            n = row["length"]
            stats = self._count_episode(part, row)
            if unknown := [task for task in row["tasks"] if task not in part.tasks]:
                raise DatasetError(
                    f"{part.root}: episode {row['episode_index']} has task {unknown[0]!r}, unknown to it"
                )
            task_numbers = tasks[[part.tasks.index(task) for task in row["tasks"]]]
            stats |= counter_stats(n, self._info["fps"], self._frame, self._episode, np.resize(task_numbers, n))
            moved: dict[str, Any] = {
                "episode_index": self._episode,
                "tasks": row["tasks"],
                "length": n,
                **_indices("data", data[part.table(row)]),
                "dataset_from_index": self._frame,
                "dataset_to_index": self._frame + n,
            }
            for key, places in videos.items():
                file, begin_s = places[part.video(row, key)]
                moved |= _indices(f"videos/{key}", file)
                for name in ("from_timestamp", "to_timestamp"):
                    moved[f"videos/{key}/{name}"] = row[f"videos/{key}/{name}"] + begin_s
            self._rows.append(moved | stats_columns(stats) | _indices("meta/episodes", self._rows_number))
            self._episode += 1
            self._frame += n

    def _count_known(self, part: OnDisk) -> None:
        """Add the statistics of a dataset's pictures, as far as it keeps their state."""
        for key, feature in part.features.items():
            if key in part.pixels and len(feature.shape) == 3:
                self._pictures.setdefault(key, picture_stats(feature)).join(part.pixels[key])

    def _uncounted(self, part: OnDisk) -> list[str]:
        """The cameras whose statistics need their pictures: other programs keep no state that can be extended."""
        return [key for key, feature in part.features.items() if len(feature.shape) == 3 and key not in part.pixels]

    def _count_episode(self, part: OnDisk, row: Mapping[str, Any]) -> dict[str, Stats]:
        """The statistics of an episode; those that it lacks are computed from its rows and pictures."""
        stats = layout.row_stats(part.root, row)
        cameras = {key: picture_stats(part.features[key]) for key in self._uncounted(part)}
        vectors: dict[str, list[Any]] = {
            key: [] for key, feature in part.features.items()
            if layout.is_numeric(feature) and len(feature.shape) != 3 and not stats.get(key, {}).keys() >= _STATISTICS
        }  # fmt: skip
        for values in (
            EpisodeRows(part, row["episode_index"], row).read([*cameras, *vectors]) if cameras or vectors else ()
        ):
            for key, counted in cameras.items():
                counted.add(values[key])
            for key, rows in vectors.items():
                rows.append(values[key])
        for key, counted in cameras.items():
            stats[key] = counted.stats()
            self._pictures.setdefault(key, picture_stats(part.features[key])).join(counted.state())
        stats |= {key: vector_stats(np.array(rows)) for key, rows in vectors.items()}
        return {
            key: {name: stats[key][name] for name in stats[key] if name in _STATISTICS}
            for key in part.features
            if key in stats
        }

    def _stats(self) -> dict[str, Stats]:
        """Statistics of all rows, old and new, with one column at a time in memory."""
        old = self._old.files(layout.DATA, "parquet") if self._old else []
        files = [*old, *sorted((self._target / layout.DATA).glob("chunk-*/file-*.parquet"))]
        stats = {}
        features = layout.features_of(self._info)
        for key in self._info["features"]:
            if key in self._pictures:
                stats[key] = self._pictures[key].stats()
            elif key in layout.COUNTERS or layout.is_numeric(features[key]):
                stats[key] = vector_stats(np.concatenate([_column(path, key) for path in files]))
        return stats

    def _append_table(self, path: Path, tasks: np.ndarray[Any, Any]) -> int:
        """Append a part's table, renumbered; returns the number of the file to which it was added."""
        size = path.stat().st_size
        limit = layout.most_mib(self._info, "data") * _MIB
        if self._table is not None and self._data.bytes + size > limit:
            self._table.close()
            self._table, self._data = None, _Place(self._data.number + 1)
        with pq.ParquetFile(path) as file:
            if self._table is None:
                target = self._target / layout.chunk_file(layout.DATA, self._data.number, "parquet")
                target.parent.mkdir(parents=True, exist_ok=True)
                self._schema = self._schema or file.schema_arrow
                self._table = pq.ParquetWriter(target, self._schema, compression="snappy")
            assert self._schema is not None
            for group in range(file.num_row_groups):
                table = file.read_row_group(group)
                try:
                    for name, offset in (("index", self._frame), ("episode_index", self._episode)):
                        table = _replaced(table, name, _numbers(table, name) + offset)
                    numbers = _numbers(table, "task_index")
                    if not all(0 <= number < len(tasks) for number in (numbers.min(initial=0), numbers.max(initial=0))):
                        raise ValueError(f"task_index from {numbers.min()} to {numbers.max()}, of {len(tasks)} in all")
                    table = _replaced(table, "task_index", tasks[numbers])
                    for key, width in self._vectors().items():
                        _check_vectors(table.column(key), key, width)
                except (LookupError, TypeError, ValueError, OverflowError, pa.ArrowException) as error:
                    raise DatasetError(f"{path}: cannot be read as {layout.INFO} says: {error!r}") from error
                try:
                    self._table.write_table(table.select(self._schema.names).cast(self._schema))
                except (KeyError, pa.ArrowException) as error:
                    raise DatasetError(
                        f"{path}: its columns do not fit those of the dataset before: {error}"
                    ) from error
        self._data.bytes += size
        return self._data.number

    def _vectors(self) -> dict[str, int]:
        """The columns of numbers, and how many each row has."""
        features = layout.features_of(self._info)
        return dict.fromkeys(layout.COUNTERS, 1) | {
            key: math.prod(feature.shape)
            for key, feature in features.items()
            if layout.is_numeric(feature) and feature.dtype != "image" and len(feature.shape) != 3
        }

    def _append_videos(self, part: OnDisk, key: str, rows: list[dict[str, Any]]) -> dict[Path, tuple[int, float]]:
        """Schedule a part's videos of a camera for joining; returns file number and start time [s] of each."""
        limit = layout.most_mib(self._info, "video") * _MIB
        frames: dict[Path, int] = {}
        for row in rows:
            path = part.video(row, key)
            frames[path] = frames.get(path, 0) + row["length"]
        placed = {}
        place = self._videos.setdefault(key, _Place(_next(self._old, f"{layout.VIDEOS}/{key}", "mp4")))
        for path, count in sorted(frames.items()):
            if not is_content(path):
                raise DatasetError(f"{path}: is missing; download the videos of the dataset too")
            size = path.stat().st_size
            if place.frames and place.bytes + size > limit:
                self._join(key)
                place = self._videos[key] = _Place(place.number + 1)
            placed[path] = (place.number, place.frames / self._info["fps"])
            self._joining.setdefault(key, []).append((path, count))
            place.bytes, place.frames = place.bytes + size, place.frames + count
        return placed

    def _join(self, key: str) -> None:
        """Write the complete video of a camera."""
        path = self._target / layout.chunk_file(f"{layout.VIDEOS}/{key}", self._videos[key].number, "mp4")
        path.parent.mkdir(parents=True, exist_ok=True)
        join_videos(self._joining[key], path, self._info["fps"])
        self._joining[key] = []

    def _flush_rows(self) -> None:
        if not self._rows:
            return
        table = table_of(self._rows, None if self._rows_table is None else self._rows_table.schema)
        if self._rows_table is None:
            path = self._target / layout.chunk_file(layout.EPISODES, self._rows_number, "parquet")
            path.parent.mkdir(parents=True)
            self._rows_table = pq.ParquetWriter(path, table.schema)
        self._rows_table.write_table(table)
        self._rows = []


def _next(old: OnDisk | None, folder: str, suffix: str) -> int:
    """The number of the first new file; existing files are never changed."""
    files = old.files(folder, suffix) if old else []
    if not files:
        return 0
    chunk, file = files[-1].parent.name.removeprefix("chunk-"), files[-1].stem.removeprefix("file-")
    return int(chunk) * layout.FILES_PER_CHUNK + int(file) + 1


def _indices(what: str, number: int) -> dict[str, int]:
    chunk, file = divmod(number, layout.FILES_PER_CHUNK)
    return {f"{what}/chunk_index": chunk, f"{what}/file_index": file}


def _check_vectors(column: pa.ChunkedArray, key: str, size: int) -> None:
    """Check that each row of a column has so many numbers.

    Raises:
        ValueError: if not.
    """
    if len(column) and (column.null_count or to_numpy(column).shape[1] != size):
        raise ValueError(f"column {key} does not have {size} numbers in each row")


def _column(path: Path, name: str) -> np.ndarray[Any, Any]:
    """A column of vectors: shape (N, D)."""
    with pq.ParquetFile(path) as file:
        values: np.ndarray[Any, Any] = to_numpy(file.read([name]).column(0))
    return values


def _numbers(table: pa.Table, name: str) -> np.ndarray[Any, np.dtype[np.int64]]:
    return np.array(table.column(name).to_pylist(), np.int64)  # to_numpy imports pandas


def _replaced(table: pa.Table, name: str, values: np.ndarray[Any, Any]) -> pa.Table:
    position = table.schema.get_field_index(name)
    field = table.schema.field(position)
    return table.set_column(position, field, to_array(values, field.type))


def _stored(info: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """How the features are stored: key -> what must be equal in all parts."""
    features = {key: (layout.feature_of(entry), entry) for key, entry in info["features"].items()}
    return {
        key: {
            "dtype": entry["dtype"],
            "shape": feature.shape,
            "names": feature.names,
            "video.codec": (entry.get("info") or {}).get("video.codec"),
        }
        for key, (feature, entry) in features.items()
    }


def _fits(present: Any, wanted: Any) -> bool:
    """Whether what two datasets store is equal, as far as both say it."""
    if isinstance(present, Mapping) and isinstance(wanted, Mapping):
        return present.keys() == wanted.keys() and all(_fits(present[key], wanted[key]) for key in present)
    return present == wanted or None in (present, wanted)


def _difference(present: Any, wanted: Any) -> str:
    if not isinstance(present, Mapping):
        return f"{present}, the others' {wanted}"
    keys = [
        key
        for key in {**wanted, **present}
        if not (key in present and key in wanted and _fits(present[key], wanted[key]))
    ]
    return "; ".join(f"{key} {present.get(key)}, the others' {wanted.get(key)}" for key in keys)
