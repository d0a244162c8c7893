"""Finds the episodes that a command line names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from ibrobot_terminal.plural import counted

from ibrobot_core.api import NS_PER_S, EpisodeSummary, RecorderError
from ibrobot_mcap.metadata import STATED
from ibrobot_mcap.owning import interrupted, is_owned
from ibrobot_mcap.reader import Rosbag2Reader, is_rosbag2


def episodes_in(path: Path) -> list[Path]:
    """The episode at `path`, or all episodes of a dataset or a folder of datasets there; sorted.

    Raises:
        RecorderError: if there is none.
    """
    if not path.exists():
        raise RecorderError(f"{path}: there is no such file or folder")
    if is_rosbag2(path):
        return [path]
    patterns = ("*", "episodes/*", "*/episodes/*")
    folders = {p for pattern in patterns for p in path.glob(pattern) if p.is_dir() and not p.name.startswith(".")}
    episodes = sorted(folder for folder in folders if is_rosbag2(folder))
    if not episodes:
        raise RecorderError(f"{path}: contains no episode")
    return episodes


@contextmanager
def opened(path: Path) -> Iterator[Rosbag2Reader]:
    """Open a reader of an episode.

    Raises:
        RecorderError: if it cannot be read.
    """
    if not path.exists():
        raise RecorderError(f"{path}: there is no such episode")
    if path.is_dir() and not is_rosbag2(path):
        episodes = episodes_in(path)
        count = "an episode" if len(episodes) == 1 else counted(len(episodes), "episode")
        raise RecorderError(f"{path}: is a folder with {count}; choose one, e.g. {episodes[0]}")
    with closing(Rosbag2Reader(path)) as reader:
        yield reader


def summary_of(path: Path) -> EpisodeSummary:
    """The summary of an episode.

    Raises:
        RecorderError: if it cannot be read.
    """
    with opened(path) as reader:
        return reader.summary()


_FIRST_DATE_NS = 365 * 86_400 * NS_PER_S
"""Times before 1971 count from the begin of something else than 1970."""


def size_of(path: Path) -> int:
    """Total size of an episode's files [bytes]."""
    size = 0
    with suppress(FileNotFoundError):  # moved meanwhile
        for file in path.rglob("*") if path.is_dir() else (path,):
            size += file.stat().st_size if file.is_file() else 0
    return size


def duration_s(summary: EpisodeSummary) -> float:
    """Time from the first to the last message [s]."""
    return (summary.end_ns - summary.start_ns) / NS_PER_S


def date_of(summary: EpisodeSummary) -> str:
    """The start of an episode, in UTC; empty if it has no messages, or begins at time 0 as those of a dataset do."""
    if summary.start_ns < _FIRST_DATE_NS:
        return ""
    return datetime.fromtimestamp(summary.start_ns / NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M")


def stated_outcome_text(summary: EpisodeSummary) -> str:
    """A remark on the outcome before the end was lost or cut off; empty if the outcome is known."""
    stated = summary.metadata.get(STATED)
    if stated is None or summary.outcome != "unknown":
        return ""
    return f"; its outcome was {stated}, now it is unknown: `ibrobot episodes mark` sets it"


def interrupted_lines(path: Path) -> Iterator[str]:
    """A line for each episode at or below `path` with an interrupted change."""
    for episode in interrupted(path):
        if not is_owned(episode):
            yield f"interrupted: {episode}: `ibrobot episodes repair {episode}` finishes the change"


def size_text(size: int) -> str:
    """A human-readable size."""
    number = float(size)
    for unit in ("B", "kB", "MB"):
        if number < 1000:
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.1f} GB"
