"""Exclusive ownership of episodes, and recovery from interrupted changes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from ibrobot_provenance.ownership import InUse, Ownership

from ibrobot_core.api import RecorderError
from ibrobot_mcap.reader import Rosbag2Reader, is_rosbag2

TRIMMING, REPAIRING, UNFINISHED, DELETING = ".trimming", ".repairing", ".unfinished", ".deleting"
"""Suffixes of hidden folders beside an episode that is changed: new episodes, and what is to be removed."""
_ALL = (TRIMMING, REPAIRING, UNFINISHED, DELETING)


@contextmanager
def owning(episode: Path, doing: str) -> Iterator[None]:
    """A context in which nobody else changes, records or converts an episode; finishes an interrupted change.

    Args:
        episode: the episode's folder, which need not exist.
        doing: what is done to it, for others' errors.

    Raises:
        InUse: if it has another owner.
        RecorderError: if it cannot be owned, e.g. on a read-only disk.
    """
    with owned(episode, doing, shared=False):
        _finish(episode)
        yield


def owned(episode: Path, doing: str, *, shared: bool) -> Ownership:
    """A context in which nobody else changes or records an episode; others may read it if `shared`.

    Raises:
        InUse: if it has another owner.
        RecorderError: if it cannot be owned.
    """
    try:
        return Ownership(episode, doing, shared=shared)
    except OSError as error:
        raise RecorderError(f"{episode}: cannot be locked: {error.strerror}") from error


def beside(episode: Path, suffix: str) -> Path:
    """The hidden folder beside an episode."""
    return episode.with_name(f".{episode.name}{suffix}")


def interrupted(path: Path) -> list[Path]:
    """The episodes at or below `path` with an interrupted or a present change."""
    below = (folder for pattern in ("episodes", "*", "*/episodes") for folder in path.glob(pattern))
    folders = [path.parent, path, *below]
    episodes = {
        left.with_name(left.name[1 : -len(suffix)])
        for folder in folders
        for suffix in _ALL
        for left in folder.glob(f".*{suffix}")
    }
    return sorted(each for each in episodes if each == path or each.parent != path.parent)


def is_owned(episode: Path) -> bool:
    """Whether an episode is being recorded or changed now."""
    try:
        Ownership(episode, "is being looked at", shared=True, wait_s=0.0).close()
    except InUse:
        return True
    except OSError:
        pass
    return False


def _finish(episode: Path) -> None:
    """Finish an interrupted trim, repair or removal of an episode.

    The original has been moved away only if the new episode is complete.
    """
    try:
        for suffix in (TRIMMING, REPAIRING):
            made = beside(episode, suffix) / episode.name
            if not episode.exists() and made.exists() and _is_whole(made):
                made.rename(episode)
            shutil.rmtree(beside(episode, suffix), ignore_errors=True)
        aside = beside(episode, UNFINISHED)
        if aside.exists() and not episode.exists():
            aside.rename(episode)
        elif aside.exists() and _is_whole(episode):
            shutil.rmtree(aside)
        shutil.rmtree(beside(episode, DELETING), ignore_errors=True)
    except OSError as error:
        raise RecorderError(f"{episode}: an interrupted change cannot be finished: {error.strerror}") from error


def _is_whole(episode: Path) -> bool:
    if not is_rosbag2(episode):
        return False
    try:
        with closing(Rosbag2Reader(episode)) as reader:
            return reader.finished and not reader.short()
    except RecorderError:
        return False
