"""Checks of what the files of a dataset say, before anything is read, computed or written by it.

Datasets come from other people: values of another type are errors that name file and key, and no count or name in them
makes this program take much memory or leave the dataset's folder.
"""

from __future__ import annotations

import math
import string
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError

_LARGEST = 2**53
"""Of counts of frames and episodes; larger ones are no whole numbers in JSON of other programs."""
_MOST_TASKS = 1_000_000
_LONGEST_SIDE = 1 << 16
"""Of pictures [px]."""
_DEPTH_UNITS = ("mm", "m")
_COUNTS = ("total_episodes", "total_frames")
_SIZES = ("data_files_size_in_mb", "video_files_size_in_mb")
_POINTER, _POINTER_SIZE = b"version https://git-lfs.github.com/spec/", 1024
"""How a pointer of Git LFS begins, and more than it is long [bytes]."""
_PLACES = frozenset({"episode_chunk", "episode_index", "video_key"})


def is_content(path: Path) -> bool:
    """Whether a file is there, rather than nothing or a pointer of Git LFS."""
    return path.exists() and not (path.stat().st_size < _POINTER_SIZE and path.read_bytes().startswith(_POINTER))


def check_content(root: Path) -> None:
    """Check that the tables of a dataset are there, other than in a clone without Git LFS.

    Raises:
        DatasetError: names a pointer in place of a table.
    """
    files = sorted(path for kind in ("meta", "data") for path in (root / kind).rglob("*") if path.is_file())
    if pointers := [path for path in files if not is_content(path)]:
        raise DatasetError(
            f"{pointers[0]}: is a pointer of Git LFS, not the file, as are {len(pointers) - 1} more of {len(files)}; "
            f"`git lfs pull` in {root} downloads them"
        )


def check_info(path: Path, info: Any) -> None:
    """Check the content of `info.json`, except for its version.

    Raises:
        DatasetError: if a value is missing or of another kind.
    """
    if not isinstance(info, dict):
        raise DatasetError(f"{path}: is not an object")
    fps = info.get("fps")
    if not _is_number(fps) or not 0 < fps <= 1e6:
        raise DatasetError(f"{path}: fps: {_shown(fps)} is not a frame rate [Hz]")
    for key in _COUNTS:
        check_count(path, key, info.get(key))
    for key in (*_SIZES, "chunks_size"):
        if key in info and not (_is_number(info[key]) and 1 <= info[key] < _LARGEST):
            raise DatasetError(f"{path}: {key}: {_shown(info[key])} is not a number from 1 on")
    if type(info.get("chunks_size", 1)) is not int:
        raise DatasetError(f"{path}: chunks_size: {_shown(info['chunks_size'])} is not a whole number")
    if not isinstance(info.get("robot_type"), str | None):
        raise DatasetError(f"{path}: robot_type: {_shown(info['robot_type'])} is not a text")
    features = info.get("features")
    if not isinstance(features, dict):
        raise DatasetError(f"{path}: features: {_shown(features)} is not an object")
    for key, entry in features.items():
        _check_feature(path, key, entry)


def _check_feature(path: Path, key: str, entry: Any) -> None:
    where = f"{path}: features: {_shown(key)}"
    if not isinstance(entry, dict) or not isinstance(entry.get("dtype"), str):
        raise DatasetError(f"{where}: {_shown(entry)} is not an object with a dtype")
    dtype, shape, more = entry["dtype"], entry.get("shape"), entry.get("info") or {}
    if not isinstance(shape, list) or not all(type(size) is int and 0 <= size < _LARGEST for size in shape):
        raise DatasetError(f"{where}: shape: {_shown(shape)} is not a list of whole numbers")
    if not isinstance(more, dict):
        raise DatasetError(f"{where}: info: {_shown(more)} is not an object")
    if dtype not in ("image", "video"):
        if len(shape) == 3 and dtype not in np.sctypeDict:
            raise DatasetError(f"{where}: dtype: {_shown(dtype)} is neither image, video nor the type of a number")
        return
    if len(shape) != 3 or not all(1 <= size < _LONGEST_SIDE for size in shape):
        raise DatasetError(f"{where}: shape: {_shown(shape)} is none of a picture")
    if ".." in PurePath(key).parts or PurePath(key).is_absolute() or "\0" in key:
        raise DatasetError(f"{where}: the name leads out of the dataset")
    if dtype == "image" and more.get("is_depth_map") and more.get("depth_unit") not in _DEPTH_UNITS:
        raise DatasetError(
            f"{where}: depth_unit: {_shown(more.get('depth_unit'))} is none of {', '.join(_DEPTH_UNITS)}"
        )


def check_count(where: object, key: str, value: Any) -> None:
    """Check a count.

    Raises:
        DatasetError: if it is not a whole number from 0 on.
    """
    if type(value) is not int or not 0 <= value < _LARGEST:
        raise DatasetError(f"{where}: {key}: {_shown(value)} is not a whole number from 0 on")


def check_template(template: str) -> None:
    """Check a path with places for the numbers of an episode, before it is filled in.

    Raises:
        ValueError: if it has other places, or formats that pad to more than 99 characters.
    """
    for _, place, form, conversion in string.Formatter().parse(template):
        if place is None:
            continue
        if place not in _PLACES or conversion or len(digits := (form or "").removesuffix("d")) > 3 or (
            digits and not digits.isdecimal()
        ) or int(digits or 0) > 99:  # fmt: skip
            raise ValueError(f"{{{place}:{form}}}")


def check_episode(where: object, row: Mapping[str, Any]) -> None:
    """Check the row of an episode.

    Raises:
        DatasetError: if a value is missing or of another kind.
    """
    for key in ("episode_index", "length", "dataset_from_index", "dataset_to_index"):
        check_count(where, key, row.get(key))
    tasks = row.get("tasks")
    if not isinstance(tasks, list) or not all(isinstance(task, str) for task in tasks):
        raise DatasetError(f"{where}: tasks: {_shown(tasks)} is not a list of texts")
    for key, value in row.items():
        if key.endswith(("/chunk_index", "/file_index")):
            check_count(where, key, value)
        elif key.endswith(("/from_timestamp", "/to_timestamp")) and not (_is_number(value) and 0 <= value < _LARGEST):
            raise DatasetError(f"{where}: {key}: {_shown(value)} is not a time [s]")


def check_tasks(where: object, numbers: Iterable[Any]) -> None:
    """Check the numbers of tasks.

    Raises:
        DatasetError: if one is no plausible number.
    """
    for number in numbers:
        if type(number) is not int or not 0 <= number < _MOST_TASKS:
            raise DatasetError(f"{where}: task_index: {_shown(number)} is not a number of a task")


def statistic(where: object, value: Any) -> NDArray[Any]:
    """A statistic as an array of numbers.

    Raises:
        DatasetError: if it has something else.
    """
    try:
        array = np.array(value)
        if not array.size:
            raise ValueError
        if array.dtype.kind in "iufb":
            return array
        array = array.astype(np.float64)  # e.g. with null, or whole numbers beyond 64 bits
    except (TypeError, ValueError, OverflowError):
        raise DatasetError(f"{where}: {_shown(value)} is not an array of numbers") from None
    if not all(each is None or _is_number(each) for each in np.array(value, object).ravel()):
        raise DatasetError(f"{where}: {_shown(value)} is not an array of numbers")
    return array


def _is_number(value: Any) -> TypeGuard[int | float]:
    return type(value) in (int, float) and (type(value) is int or math.isfinite(value))


def _shown(value: Any) -> str:
    """A value, in an error."""
    if type(value) is int and abs(value) > 2**64:
        return "a number of many digits"
    text = repr(value)
    return text if len(text) < 80 else f"{text[:76]} ..."
