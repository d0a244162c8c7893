"""LeRobot datasets on disk: paths, `info.json`, table schemas and metadata. v3.0 is written; v2.0 and v2.1 are read."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from ibrobot_provenance.datasets import element_names
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature
from ibrobot_lerobot.arrow import table_of
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.plausible import (
    check_content,
    check_count,
    check_episode,
    check_info,
    check_tasks,
    check_template,
    statistic,
)

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
OWN = "meta/ibrobot.json"
"""The metadata passed to `create` and `merge`; LeRobot ignores it."""
PIXELS = "meta/ibrobot_pixels.json"
"""State of the image statistics, to which episodes can be added later: key -> `PictureStats.state`."""
DATA = "data"
EPISODES = "meta/episodes"
VIDEOS = "videos"
FILES_PER_CHUNK = 1000
COUNTERS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that the writer generates."""
_VERSION = "v3.0"
_TASKS_LINES, _EPISODES_LINES, _STATS_LINES = "meta/tasks.jsonl", "meta/episodes.jsonl", "meta/episodes_stats.jsonl"
"""Files of v2.0 and v2.1."""
_PICTURE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_NUMBERS = (*(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)), "float16", "float32", "float64")
_DEPTH_UNITS = {"uint16": "mm", "float32": "m"}


def chunk_file(folder: str, number: int, suffix: str) -> str:
    """Path of file `number`, counted from 0, in a folder below the root."""
    chunk, file = divmod(number, FILES_PER_CHUNK)
    return f"{folder}/chunk-{chunk:03d}/file-{file:03d}.{suffix}"


@attrs.frozen
class Column:
    """A feature and how it is stored."""

    key: str
    feature: Feature
    storage: str
    """`video`, `image`, `depth` or `vector`."""

    @property
    def info(self) -> dict[str, Any]:
        """Its entry in `info.json`."""
        dtype = {"vector": self.feature.dtype, "depth": "image"}.get(self.storage, self.storage)
        entry: dict[str, Any] = {
            "dtype": dtype,
            "shape": list(self.feature.shape),
            "names": list(self.feature.names) or None,
        }
        if self.storage == "depth":
            entry["info"] = {"is_depth_map": True, "depth_unit": _DEPTH_UNITS[self.feature.dtype]}
        return entry

    @property
    def arrow(self) -> pa.DataType:
        """Its type in the tables."""
        if self.storage != "vector":
            return _PICTURE
        element = pa.from_numpy_dtype(np.dtype(self.feature.dtype))
        return element if self.feature.shape == (1,) else pa.list_(element, self.feature.shape[0])

    @property
    def hugging_face(self) -> dict[str, Any]:
        """Its description in the tables' metadata."""
        if self.storage != "vector":
            return {"_type": "Image"}
        value = {"dtype": self.feature.dtype, "_type": "Value"}
        return (
            value
            if self.feature.shape == (1,)
            else {"feature": value, "length": self.feature.shape[0], "_type": "List"}
        )


def columns(features: Mapping[str, Feature], *, videos: bool) -> dict[str, Column]:
    """The columns in which features are stored, by key.

    Raises:
        DatasetError: if LeRobot cannot store a feature.
    """
    stored = {}
    for key, feature in features.items():
        if key in COUNTERS or key == "task" or "/" in key:
            raise DatasetError(f"feature {key!r}: the name is reserved by LeRobot or contains a slash")
        stored[key] = Column(key, feature, _storage(key, feature, videos))
    return stored


def _storage(key: str, feature: Feature, videos: bool) -> str:
    if min(feature.shape, default=0) < 1:
        raise DatasetError(f"feature {key!r} has shape {feature.shape}; every dimension must be at least 1")
    picture = len(feature.shape) == 3
    if feature.dtype == "image" and picture and feature.shape[2] in (1, 3):
        return "video" if videos and feature.shape[2] == 3 else "image"
    if feature.dtype in _DEPTH_UNITS and picture and feature.shape[2] == 1:
        return "depth"
    if len(feature.shape) == 1 and feature.dtype in ("bool", "float32", "float64", "int32", "int64", "uint8", "uint16"):
        return "vector"
    raise DatasetError(f"feature {key!r}: {feature.dtype} of shape {feature.shape} is neither a vector nor an image")


def table_schema(stored: Mapping[str, Column]) -> pa.Schema:
    """The schema of the data tables, in LeRobot's order of columns."""
    kept = [column for column in stored.values() if column.storage != "video"]
    fields = [pa.field(column.key, column.arrow) for column in kept]
    fields += [pa.field(key, pa.from_numpy_dtype(np.dtype(dtype))) for key, dtype in COUNTERS.items()]
    described = {column.key: column.hugging_face for column in kept}
    described |= {key: {"dtype": dtype, "_type": "Value"} for key, dtype in COUNTERS.items()}
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": described}})})


def most_mib(info: Mapping[str, Any], kind: str) -> float:
    """Size at which a new file of a kind, `data` or `video`, begins [MiB]; LeRobot's default if `info` lacks it."""
    defaults = LeRobotOptions()
    default = defaults.table_file_mb if kind == "data" else defaults.video_file_mb
    return float(info.get(f"{kind}_files_size_in_mb", default))


def new_info(stored: Mapping[str, Column], fps: float, robot_type: str, table_mb: int, video_mb: int) -> dict[str, Any]:
    """`info.json` of a dataset without episodes."""
    features = {key: column.info for key, column in stored.items()}
    features |= {key: {"dtype": dtype, "shape": [1], "names": None} for key, dtype in COUNTERS.items()}
    return {
        "codebase_version": _VERSION, "fps": fps, "features": features,
        "total_episodes": 0, "total_frames": 0, "total_tasks": 0,
        "chunks_size": FILES_PER_CHUNK, "data_files_size_in_mb": table_mb, "video_files_size_in_mb": video_mb,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "robot_type": robot_type, "splits": {},
    }  # fmt: skip


def current_info(info: Mapping[str, Any]) -> dict[str, Any]:
    """`info.json` of an older dataset as this version has it, without episodes."""
    sizes = LeRobotOptions()
    form = new_info({}, info["fps"], info.get("robot_type") or "", sizes.table_file_mb, sizes.video_file_mb)
    return form | {"features": info["features"]}


def features_of(info: Mapping[str, Any]) -> dict[str, Feature]:
    """The features of `info.json`, without the writer's own columns."""
    return {key: feature_of(entry) for key, entry in info["features"].items() if key not in COUNTERS}


def is_numeric(feature: Feature) -> bool:
    """Whether a feature has statistics: text and LeRobot's language columns have none."""
    return feature.dtype in ("bool", "image", *_NUMBERS)


def task_table(tasks: list[str]) -> pa.Table:
    """`tasks.parquet`: the number of each task; pandas reads the task as its index."""
    text = {"pandas_type": "unicode", "numpy_type": "object"}
    number = {"pandas_type": "int64", "numpy_type": "int64"}
    described = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **number, "metadata": None},
            {"name": "task", "field_name": "task", **text, "metadata": None},
        ],
        "attributes": {},
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    schema = pa.schema({"task_index": pa.int64(), "task": pa.string()}, {"pandas": json.dumps(described)})
    return table_of([{"task_index": number, "task": task} for number, task in enumerate(tasks)], schema)


@attrs.frozen
class OnDisk:
    """An open dataset."""

    root: Path
    info: dict[str, Any]
    stats: dict[str, Any]
    """Feature -> name -> nested lists; empty without episodes."""
    tasks: list[str]
    """Tasks, ordered by number."""
    metadata: dict[str, Any]
    pixels: dict[str, Any]
    """Camera key -> state of its statistics; empty for datasets that ibrobot did not make."""

    @property
    def videos(self) -> list[str]:
        """The keys of the cameras that are stored as videos."""
        return [key for key, entry in self.info["features"].items() if entry["dtype"] == "video"]

    @property
    def cameras(self) -> list[str]:
        """The keys of all cameras."""
        return [key for key, entry in self.info["features"].items() if entry["dtype"] in ("video", "image")]

    @property
    def features(self) -> dict[str, Feature]:
        """The features given to `create`."""
        return features_of(self.info)

    @property
    def is_current(self) -> bool:
        """Whether it has the version that is written, so that it can grow."""
        return bool(self.info["codebase_version"] == _VERSION)

    def episodes(self) -> Iterator[dict[str, Any]]:
        """The rows of `meta/episodes`, in order.

        Raises:
            DatasetError: if they cannot be read.
        """
        for path in self.files(EPISODES, "parquet"):
            try:
                with pq.ParquetFile(path) as file:
                    for batch in file.iter_batches(batch_size=64):
                        for row in batch.to_pylist():
                            check_episode(path, row)
                            yield row
            except (OSError, pa.ArrowException) as error:
                raise DatasetError(f"{path}: cannot be read: {error}") from error

    def files(self, folder: str, suffix: str) -> list[Path]:
        """The files of a folder below the root, in order."""
        return sorted((self.root / folder).glob(f"chunk-*/file-*.{suffix}"))

    def tables(self) -> list[Path]:
        """The files of all rows, in their order."""
        return self.files(DATA, "parquet")

    def table(self, row: Mapping[str, Any]) -> Path:
        """The file with the rows of an episode."""
        return self.root / chunk_file(DATA, self._file(row, "data"), "parquet")

    def video(self, row: Mapping[str, Any], key: str) -> Path:
        """The file with a camera's pictures of an episode."""
        folder = f"{VIDEOS}/{key}"
        return self.root / chunk_file(folder, self._file(row, folder), "mp4")

    def _file(self, row: Mapping[str, Any], what: str) -> int:
        """Number of the file, counted from 0, that an episode's row names for `what`, e.g. `data`.

        Raises:
            DatasetError: if it names none.
        """
        chunk, file = row.get(f"{what}/chunk_index"), row.get(f"{what}/file_index")
        if chunk is None or file is None:
            raise DatasetError(
                f"{self.root}: meta/episodes: episode {row.get('episode_index')}: {what}/chunk_index and"
                f" {what}/file_index are {chunk} and {file}: whole numbers from 0 on name its file"
            )
        return int(chunk * FILES_PER_CHUNK + file)


class OlderOnDisk(OnDisk):
    """An open dataset of v2.0 or v2.1: a table, and a video of each camera, for each episode."""

    @override
    def episodes(self) -> Iterator[dict[str, Any]]:
        stats = {}
        for row in _lines(self.root / _STATS_LINES, "episode_index", "stats"):
            check_count(self.root / _STATS_LINES, "episode_index", row["episode_index"])
            each = row["stats"]
            if not isinstance(each, dict) or not all(isinstance(values, dict) for values in each.values()):
                raise DatasetError(
                    f"{self.root / _STATS_LINES}: stats of episode {row['episode_index']} are no objects"
                )
            stats[row["episode_index"]] = each
        begin = 0
        path = self.root / _EPISODES_LINES
        rows = list(_lines(path, "episode_index", "tasks", "length"))
        for row in rows:
            check_episode(path, {**row, "dataset_from_index": 0, "dataset_to_index": 0})
        for row in sorted(rows, key=lambda row: row["episode_index"]):
            length = row["length"]
            times = {"from_timestamp": 0.0, "to_timestamp": length / self.info["fps"]}
            yield {
                "episode_index": row["episode_index"],
                "tasks": row["tasks"],
                "length": length,
                "dataset_from_index": begin,
                "dataset_to_index": begin + length,
                **{f"{VIDEOS}/{key}/{name}": time for key in self.videos for name, time in times.items()},
                **{
                    f"stats/{key}/{name}": value
                    for key, each in stats.get(row["episode_index"], {}).items()
                    for name, value in each.items()
                },
            }
            begin += length

    @override
    def tables(self) -> list[Path]:
        return [self.table(row) for row in self.episodes()]

    @override
    def table(self, row: Mapping[str, Any]) -> Path:
        return self._path("data_path", row["episode_index"])

    @override
    def video(self, row: Mapping[str, Any], key: str) -> Path:
        return self._path("video_path", row["episode_index"], video_key=key)

    def _path(self, template: str, number: int, **more: str) -> Path:
        """The file of an episode, below the root, as `info.json` names it."""
        text: Any = self.info.get(template)
        try:
            check_template(text)
            path = Path(text.format(episode_chunk=number // self.info["chunks_size"], episode_index=number, **more))
        except (KeyError, IndexError, ValueError, AttributeError, TypeError) as error:
            raise DatasetError(
                f"{self.root / INFO}: {template}: {text!r} is no path of an episode: {error!r}"
            ) from None
        if path.is_absolute() or ".." in path.parts:
            raise DatasetError(f"{self.root / INFO}: {template}: {text!r} leads out of the dataset")
        return self.root / path


_OLDER = {"v2.0": OlderOnDisk, "v2.1": OlderOnDisk}
"""Version -> how it is read."""


def open_dataset(root: Path) -> OnDisk | None:
    """The dataset at `root`; None if there is none.

    Raises:
        DatasetError: if it cannot be read, or has another version.
    """
    if not (root / INFO).exists():
        return None
    check_content(root)
    try:
        info = json.loads((root / INFO).read_bytes(), parse_constant=_no_constant)
        stats = json.loads((root / STATS).read_bytes()) if (root / STATS).exists() else {}
        tasks = _read_tasks(root)
        metadata = json.loads((root / OWN).read_bytes()) if (root / OWN).exists() else {}
        pixels = json.loads((root / PIXELS).read_bytes()) if (root / PIXELS).exists() else {}
        version = info["codebase_version"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, pa.ArrowException) as error:
        raise DatasetError(f"{root}: is not a LeRobot dataset: {error!r}") from error
    opened = OnDisk if version == _VERSION else _OLDER.get(str(version))
    if opened is None:
        known = ", ".join((*_OLDER, _VERSION))
        raise DatasetError(f"{root / INFO}: codebase_version: {version!r} cannot be read; versions that can: {known}")
    check_info(root / INFO, info)
    return opened(root, info, stats, tasks, metadata, pixels)


def _no_constant(name: str) -> None:
    """Refuse what JSON does not have, and what could not be written again."""
    raise ValueError(f"{name} is no JSON")


def existing_dataset(root: Path) -> OnDisk:
    """The dataset at `root`.

    Raises:
        DatasetError: if there is none, it cannot be read, or has another version.
    """
    dataset = open_dataset(root)
    if dataset is None:
        raise DatasetError(f"{root}: is not a LeRobot dataset: it has no {INFO}")
    return dataset


def _read_tasks(root: Path) -> list[str]:
    """The tasks, ordered by number; a number that no task has is an empty one.

    LeRobot 0.4 leaves the index of its table without a name, which pyarrow then calls `__index_level_0__`.
    """
    if (root / TASKS).exists():
        with pq.ParquetFile(root / TASKS) as file:
            rows = file.read().to_pylist()
    else:
        rows = list(_lines(root / _TASKS_LINES, "task_index", "task"))
    check_tasks(root, (row.get("task_index") for row in rows))
    named = {row["task_index"]: _task(row) for row in rows}
    return [named.get(number, "") for number in range(max(named, default=-1) + 1)]


def _task(row: Mapping[str, Any]) -> str:
    texts = [value for value in row.values() if isinstance(value, str)]
    return str(row["task"]) if "task" in row or len(texts) != 1 else texts[0]


def _lines(path: Path, *keys: str) -> Iterator[dict[str, Any]]:
    """The objects of a file of JSON lines, with certain keys; none if there is no such file.

    Raises:
        DatasetError: if it cannot be read.
    """
    if not path.exists():
        return
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise DatasetError(f"{path}:{number}: is no JSON: {error}") from None
        if not isinstance(row, dict) or not row.keys() >= {*keys}:
            raise DatasetError(f"{path}:{number}: {line[:40]!r} is no object with {', '.join(keys)}")
        yield row


def row_stats(root: Path, row: Mapping[str, Any]) -> dict[str, dict[str, NDArray[Any]]]:
    """The statistics in an episode's row: feature -> name -> values.

    Raises:
        DatasetError: if some have no numbers.
    """
    stats: dict[str, dict[str, NDArray[Any]]] = {}
    for column, value in row.items():
        if column.startswith("stats/"):
            key, _, name = column.removeprefix("stats/").rpartition("/")
            where = f"{root}: statistics of episode {row['episode_index']}: {key}: {name}"
            stats.setdefault(key, {})[name] = statistic(where, value)
    return stats


def write_json(path: Path, document: Any) -> None:
    """Write a JSON file, and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=4, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def feature_of(entry: Mapping[str, Any]) -> Feature:
    """A feature from its entry in `info.json`; older datasets have pictures with their channels first."""
    dtype, shape, names = _dtype(entry), tuple(entry["shape"]), element_names(entry.get("names"))
    if dtype == "image" and len(shape) == 3 and names[:1] in (("channel",), ("channels",)):
        shape, names = (*shape[1:], shape[0]), (*names[1:], names[0])
    return Feature(dtype, shape, names)


def _dtype(entry: Mapping[str, Any]) -> str:
    more = entry.get("info") or {}
    if entry["dtype"] == "image" and more.get("is_depth_map"):
        return next(dtype for dtype, unit in _DEPTH_UNITS.items() if unit == more.get("depth_unit"))
    return "image" if entry["dtype"] == "video" else str(entry["dtype"])
