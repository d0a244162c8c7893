"""Deletes and trims episodes so that both can be undone: the original moves to a trash folder beside the episode.

`FOLDER/.trash/ID/` holds one original under its own name, and `undo.json` with what was done. Commands that search for
episodes skip folders whose names begin with a dot.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path

import attrs

from ibrobot_core.api import EpisodeSummary, RecorderError, ns, seconds
from ibrobot_mcap.changes import DELETED, REPLACED, TRIMMED
from ibrobot_mcap.owning import DELETING, TRIMMING, beside, owned, owning
from ibrobot_mcap.reader import Rosbag2Reader, is_rosbag2
from ibrobot_mcap.rewrite import rewrite

TRASH = ".trash"
_NOTE = "undo.json"


@attrs.frozen
class Trashed:
    """An original in a trash folder."""

    folder: Path
    """`FOLDER/.trash/ID`."""
    name: str
    """Name of the episode."""
    done: str
    link: str | None = None
    """The target, if it was a link to an episode."""

    @property
    def id(self) -> str:
        """Unique within its trash folder; ids sort by time."""
        return self.folder.name

    @property
    def kept(self) -> Path:
        """Where the original is now."""
        return self.folder / self.name

    @property
    def origin(self) -> Path:
        """Where the original was."""
        return self.folder.parents[1] / self.name


def discard(episode: Path) -> Trashed:
    """Move an episode to the trash folder beside it.

    Raises:
        InUse: if it is being recorded or changed.
        RecorderError: if it is not an episode's folder, or cannot be moved.
    """
    with owning(episode, "is being deleted"):
        return _discard(episode, DELETED)


def check_is_episode(episode: Path) -> None:
    """Check that a folder is an episode, before it is deleted.

    Raises:
        RecorderError: if it is not.
    """
    if not (episode.is_dir() and is_rosbag2(episode)):
        raise RecorderError(f"{episode}: is not an episode; nothing was deleted")


def delete(episode: Path) -> None:
    """Delete an episode for good; of a link to one, the link.

    Raises:
        InUse: if it is being recorded or changed.
        RecorderError: if it is not an episode's folder, or cannot be removed.
    """
    with owning(episode, "is being deleted"):
        check_is_episode(episode)
        try:
            if episode.is_symlink():
                episode.unlink()
            else:
                shutil.rmtree(episode.rename(beside(episode, DELETING)))
        except OSError as error:
            raise RecorderError(f"{episode}: cannot be deleted: {error.strerror}") from error


def _discard(episode: Path, done: str) -> Trashed:
    check_is_episode(episode)
    try:
        link = os.readlink(episode) if episode.is_symlink() else None
        trashed = Trashed(_new_folder(episode.parent / TRASH), episode.name, done, link)
        note = {"name": episode.name, "done": done} | ({"link": link} if link is not None else {})
        (trashed.folder / _NOTE).write_text(json.dumps(note), encoding="utf-8")
        if link is None:
            episode.rename(trashed.kept)
        else:  # a relative one would be wrong there
            trashed.kept.symlink_to(episode.resolve())
            episode.unlink()
    except OSError as error:
        raise RecorderError(f"{episode}: cannot be moved to {TRASH}: {error.strerror}") from error
    return trashed


def trim(episode: Path, begin_s: float, end_s: float | None) -> tuple[EpisodeSummary, Trashed]:
    """Replace an episode by a part of it; the original moves to the trash folder once the part is complete.

    Args:
        episode: the episode's folder.
        begin_s: begin of the part, from the first message [s].
        end_s: end of the part [s]; None for the end of the episode.

    Raises:
        InUse: if the episode is being recorded or changed.
        RecorderError: if the part is not within the episode, or cannot be written; the episode is then unchanged.
    """
    with owning(episode, "is being trimmed"):
        if episode.is_file():
            raise RecorderError(f"{episode}: must be the episode's folder, not a file of it")
        return _trim(episode, begin_s, end_s)


def _trim(episode: Path, begin_s: float, end_s: float | None) -> tuple[EpisodeSummary, Trashed]:
    staging = beside(episode, TRIMMING)
    try:
        staging.mkdir()
        made = _copy_part(episode, staging / episode.name, begin_s, end_s)
        trashed = _discard(episode, TRIMMED)
        try:
            made.path.rename(episode)
        except BaseException:
            _put_back(trashed, episode)
            raise
    except OSError as error:
        raise RecorderError(f"{episode}: cannot be trimmed: {error.strerror}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return attrs.evolve(made, path=episode), trashed


def copy_part(episode: Path, output: Path, begin_s: float, end_s: float | None) -> EpisodeSummary:
    """Copy a part of an episode to a new one; arguments and errors as of `trim`."""
    with owned(episode, "is being copied", shared=True), owning(output, "is being written"):
        return _copy_part(episode, output, begin_s, end_s)


def _copy_part(episode: Path, output: Path, begin_s: float, end_s: float | None) -> EpisodeSummary:
    with closing(Rosbag2Reader(episode)) as reader:
        summary = reader.summary()
    start_ns, length_ns = summary.start_ns, summary.end_ns - summary.start_ns
    begin_ns = ns(begin_s)
    end_ns = length_ns if end_s is None else ns(end_s)
    if not 0 <= begin_ns < end_ns <= length_ns:
        part = f"--from {begin_s:g} --to {seconds(end_ns):g}"
        raise RecorderError(f"{episode}: is {seconds(length_ns):.2f} s long; {part} is outside it")
    marks = {"trimmed": f"{begin_s:g} s to {seconds(end_ns):g} s of {episode.name}"}
    return rewrite(episode, output, begin_ns=start_ns + begin_ns, end_ns=start_ns + end_ns, marks=marks)


def trashed_in(path: Path) -> list[Trashed]:
    """The originals in the trash folders at or below `path`, oldest first."""
    originals = {each.folder: each for each in _originals(path)}  # a dataset's trash matches two patterns
    return sorted(originals.values(), key=lambda each: (each.id, each.name))


def restore(trashed: Trashed) -> Path:
    """Put an original back. The trimmed episode takes its place in the trash.

    Returns:
        Where it is now: its own place, or `NAME_restored` if a later recording has taken its name.

    Raises:
        InUse: if an episode in its place is being recorded or changed.
        RecorderError: if it cannot be moved.
    """
    origin = trashed.origin
    with owning(origin, "is being restored"):
        try:
            if not trashed.kept.exists():
                raise RecorderError(f"{trashed.kept}: is no longer there; another command restored or deleted it")
            if origin.exists() and trashed.done in (TRIMMED, REPLACED):
                _discard(origin, REPLACED)
            while origin.exists():
                origin = origin.with_name(f"{origin.name}_restored")
            _put_back(trashed, origin)
            with suppress(OSError):  # not empty
                trashed.folder.parent.rmdir()
        except OSError as error:
            raise RecorderError(f"{trashed.kept}: cannot be restored: {error.strerror}") from error
    return origin


def _put_back(trashed: Trashed, origin: Path) -> None:
    """Move an original to `origin`, and remove its folder in the trash."""
    if trashed.link is None:
        trashed.kept.rename(origin)
    else:
        origin.symlink_to(trashed.link)
    shutil.rmtree(trashed.folder)


def empty(path: Path) -> list[Trashed]:
    """Delete the originals in the trash folders at or below `path` for good, and return them.

    Raises:
        RecorderError: if one cannot be deleted.
    """
    originals = trashed_in(path)
    try:
        for trashed in originals:
            shutil.rmtree(trashed.folder)
            with suppress(OSError):  # not empty
                trashed.folder.parent.rmdir()
    except OSError as error:
        raise RecorderError(f"{path}: cannot be emptied: {error.strerror}") from error
    return originals


def _new_folder(trash: Path) -> Path:
    """A new folder named after the time, so that names sort by age."""
    for number in itertools.count():
        folder = trash / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}-{number}"
        with suppress(FileExistsError):
            folder.mkdir(parents=True)  # a simultaneous restore may have removed the empty trash
            return folder
    raise AssertionError


def _originals(path: Path) -> Iterator[Trashed]:
    for pattern in (TRASH, f"episodes/{TRASH}", f"*/{TRASH}", f"*/episodes/{TRASH}"):
        for note in path.glob(f"{pattern}/*/{_NOTE}"):
            try:
                content = json.loads(note.read_text(encoding="utf-8"))
                link = content.get("link")
                trashed = Trashed(note.parent, Path(content["name"]).name, str(content["done"]), link and str(link))
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                continue  # not ours
            if not trashed.name.startswith(".") and trashed.kept.is_dir() and is_rosbag2(trashed.kept):
                yield trashed
