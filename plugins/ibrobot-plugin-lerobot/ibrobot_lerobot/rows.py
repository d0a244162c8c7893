"""Reads the rows of an episode: vectors and images from tables, and the matching images from videos."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import closing
from typing import Any

import av
import av.error
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError, Feature
from ibrobot_lerobot.layout import INFO, OnDisk
from ibrobot_lerobot.pictures import decode_picture
from ibrobot_lerobot.plausible import is_content

_ROWS_AT_ONCE = 32


class EpisodeRows:
    """One episode of a dataset.

    Args:
        dataset: the dataset.
        number: the episode, from 0.
        row: what `dataset.episodes()` says of it, if that is known.

    Raises:
        DatasetError: if there is no such episode.
    """

    def __init__(self, dataset: OnDisk, number: int, row: Mapping[str, Any] | None = None) -> None:
        total = dataset.info["total_episodes"]
        row = row or next((row for row in dataset.episodes() if row["episode_index"] == number), None)
        if row is None:
            available = f"0 to {total - 1}" if total else "none"
            raise DatasetError(f"{dataset.root}: has no episode {number}; available: {available}")
        self._dataset = dataset
        self._number = number
        self._row = row
        self.length: int = row["length"]
        self.tasks: list[str] = list(row["tasks"])
        self.begin: int = row["dataset_from_index"]
        """Number of frames in the dataset before this episode."""

    def read(self, keys: Collection[str], first: int = 0) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield each row from `first` on as key -> value: stored vectors, shape (N,), and images, shape (H, W, C).

        Raises:
            DatasetError: if a file cannot be read, or has fewer rows or images than the episode.
        """
        videos = [key for key in self._dataset.videos if key in keys]
        features = {key: each for key, each in self._dataset.features.items() if key in keys and key not in videos}
        pictures = {key: self._pictures(key, first) for key in videos}
        rows = first
        try:
            for values in itertools.islice(self._table(features), first, None):
                rows += 1
                if rows > self.length:
                    continue  # count them for the error
                yield values | {key: next(each) for key, each in pictures.items()}
        finally:
            for each in pictures.values():
                each.close()
        if rows != self.length:
            raise DatasetError(f"{self._dataset.root}: episode {self._number} has {rows} rows, must have {self.length}")

    def _table(self, features: dict[str, Feature]) -> Iterator[dict[str, NDArray[Any]]]:
        path = self._dataset.table(self._row)
        try:
            with pq.ParquetFile(path) as file:
                for group in range(file.num_row_groups):
                    if self._number not in file.read_row_group(group, ["episode_index"]).column(0).to_pylist():
                        continue
                    columns = ["episode_index", *features]
                    for batch in file.iter_batches(_ROWS_AT_ONCE, [group], columns):
                        for row in batch.to_pylist():
                            if row["episode_index"] == self._number:
                                yield {key: _value(key, row[key], feature) for key, feature in features.items()}
        except (OSError, pa.ArrowException, DatasetError) as error:
            raise DatasetError(f"{path}: cannot be read: {error}") from error
        except (LookupError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise DatasetError(f"{path}: cannot be read as {self._dataset.root / INFO} says: {error!r}") from error

    def _pictures(self, key: str, first: int) -> Generator[NDArray[Any]]:
        """The episode's part of a camera's video, from row `first` on."""
        path = self._dataset.video(self._row, key)
        if not is_content(path):
            raise DatasetError(
                f"{path}: is missing; download the videos of the dataset too, or use a robot YAML whose contract has "
                f"no {key}"
            )
        fps = self._dataset.info["fps"]
        begin = round(self._row[f"videos/{key}/from_timestamp"] * fps)
        wanted = begin + first
        try:
            with av.open(str(path)) as container, closing(_decoded(container, wanted / fps)) as frames:
                for frame in frames:
                    number = round(float(frame.time) * fps)
                    if number < wanted:
                        continue
                    if number > wanted:
                        break
                    yield frame.to_ndarray(format="rgb24")
                    wanted += 1
                    if wanted == begin + self.length:
                        return
        except (av.error.FFmpegError, OSError) as error:
            raise DatasetError(f"{path}: cannot be read: {error}") from error
        raise DatasetError(f"{path}: has no image at {wanted / fps:.3f} s, within episode {self._number}")


def _decoded(container: Any, begin_s: float) -> Generator[Any]:
    """Decode images, starting with the last key frame before `begin_s` [s]."""
    stream = container.streams.video[0]
    container.seek(max(0, int(begin_s / stream.time_base)), stream=stream)
    yield from container.decode(stream)


def _value(key: str, stored: Any, feature: Feature) -> NDArray[Any]:
    if len(feature.shape) == 3:
        content = (stored or {}).get("bytes")
        if content is None:
            raise DatasetError(f"{key}: its images are not in the tables")
        return decode_picture(content, feature)
    return np.asarray(stored, np.dtype(feature.dtype)).reshape(-1)
