"""Deletes and trims episodes so that both can be undone: the original moves to a trash folder beside the episode.

`FOLDER/.trash/ID/` holds one original under its own name, and `undo.json`, which says what was done. Commands that look
for episodes skip folders whose names begin with a dot.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import attrs

from ibrobot_core.api import RecorderError, ns, seconds
from ibrobot_mcap.reader import Rosbag2Reader, is_rosbag2
from ibrobot_mcap.rewrite import Rewritten, rewrite

TRASH = ".trash"
_NOTE = "undo.json"
DELETED, TRIMMED, REPLACED = "deleted", "trimmed", "replaced"
"""What was done: deleted, trimmed, or replaced when a trim was undone."""


@attrs.frozen
class Trashed:
    """An original in a trash folder."""

    folder: Path
    """`FOLDER/.trash/ID`."""
    name: str
    """Name of the episode."""
    done: str

    @property
    def id(self) -> str:
        """Names it within its trash folder; later ones sort behind earlier ones."""
        return self.folder.name

    @property
    def kept(self) -> Path:
        """Where the original is now."""
        return self.folder / self.name

    @property
    def origin(self) -> Path:
        """Where the original was."""
        return self.folder.parents[1] / self.name


def discard(episode: Path, done: str = DELETED) -> Trashed:
    """Move an episode to the trash folder beside it.

    Raises:
        RecorderError: if it is not an episode's folder, or cannot be moved.
    """
    if not (episode.is_dir() and is_rosbag2(episode)):
        raise RecorderError(f"{episode}: is not an episode; nothing was moved")
    try:
        trash = episode.parent / TRASH
        trash.mkdir(exist_ok=True)
        trashed = Trashed(_new_folder(trash), episode.name, done)
        (trashed.folder / _NOTE).write_text(json.dumps({"name": episode.name, "done": done}), encoding="utf-8")
        episode.rename(trashed.kept)
    except OSError as error:
        raise RecorderError(f"{episode}: cannot be moved to {TRASH}: {error.strerror}") from error
    return trashed


def trim(episode: Path, begin_s: float, end_s: float | None) -> tuple[Rewritten, Trashed]:
    """Replace an episode by a part of it; the original moves to the trash folder once the part is complete.

    Args:
        episode: the episode's folder.
        begin_s: begin of the part, from the first message [s].
        end_s: end of the part [s]; None for the end of the episode.

    Raises:
        RecorderError: if the part is not within the episode, or cannot be written; the episode is then unchanged.
    """
    if not episode.is_dir():
        raise RecorderError(f"{episode}: must be the episode's folder, not a file of it")
    staging = episode.with_name(f".{episode.name}.trimming")
    try:
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir()
        made = copy_part(episode, staging / episode.name, begin_s, end_s)
        trashed = discard(episode, TRIMMED)
        made.path.rename(episode)
    except OSError as error:
        raise RecorderError(f"{episode}: cannot be trimmed: {error.strerror}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return Rewritten(episode, attrs.evolve(made.summary, path=episode)), trashed


def copy_part(episode: Path, output: Path, begin_s: float, end_s: float | None) -> Rewritten:
    """Copy a part of an episode to a new one; arguments and errors as of `trim`."""
    reader = Rosbag2Reader(episode)
    try:
        summary = reader.summary()
    finally:
        reader.close()
    start_ns, length_ns = summary.start_ns, summary.end_ns - summary.start_ns
    begin_ns = ns(begin_s)
    end_ns = length_ns if end_s is None else ns(end_s)
    if not 0 <= begin_ns < end_ns <= length_ns:
        asked = f"--from {begin_s:g} --to {seconds(end_ns):g}"
        raise RecorderError(f"{episode}: is {seconds(length_ns):.2f} s long; {asked} is outside it")
    marks = {"trimmed": f"{begin_s:g} s to {seconds(end_ns):g} s of {episode.name}"}
    return rewrite(episode, output, begin_ns=start_ns + begin_ns, end_ns=start_ns + end_ns, marks=marks)


def trashed_in(path: Path) -> list[Trashed]:
    """The originals in the trash folders at or below `path`, oldest first."""
    found = {each.folder: each for each in _found(path)}  # a dataset's trash matches two patterns
    return sorted(found.values(), key=lambda each: (each.id, each.name))


def restore(trashed: Trashed) -> Path:
    """Put an original back. What a trim had made of it moves to the trash in its place.

    Returns:
        Where it is now: its own place, or `NAME_restored` if a later recording has taken its name.

    Raises:
        RecorderError: if it cannot be moved.
    """
    origin = trashed.origin
    try:
        if origin.exists() and trashed.done in (TRIMMED, REPLACED):
            discard(origin, REPLACED)
        while origin.exists():
            origin = origin.with_name(f"{origin.name}_restored")
        trashed.kept.rename(origin)
        shutil.rmtree(trashed.folder)
        if not any(trashed.folder.parent.iterdir()):
            trashed.folder.parent.rmdir()
    except OSError as error:
        raise RecorderError(f"{trashed.kept}: cannot be restored: {error.strerror}") from error
    return origin


def empty(path: Path) -> list[Trashed]:
    """Delete the originals in the trash folders at or below `path` for good, and return them.

    Raises:
        RecorderError: if one cannot be deleted.
    """
    found = trashed_in(path)
    try:
        for trashed in found:
            shutil.rmtree(trashed.folder)
            if not any(trashed.folder.parent.iterdir()):
                trashed.folder.parent.rmdir()
    except OSError as error:
        raise RecorderError(f"{path}: cannot be emptied: {error.strerror}") from error
    return found


def _new_folder(trash: Path) -> Path:
    """A new folder named after the time, so that names sort by age."""
    for number in itertools.count():
        folder = trash / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}-{number}"
        if not folder.exists():
            folder.mkdir()
            return folder
    raise AssertionError


def _found(path: Path) -> Iterator[Trashed]:
    for pattern in (TRASH, f"episodes/{TRASH}", f"*/{TRASH}", f"*/episodes/{TRASH}"):
        for note in path.glob(f"{pattern}/*/{_NOTE}"):
            try:
                known = json.loads(note.read_text(encoding="utf-8"))
                found = Trashed(note.parent, Path(known["name"]).name, str(known["done"]))
            except (OSError, ValueError, KeyError, TypeError):
                continue  # not from here
            if not found.name.startswith(".") and found.kept.is_dir() and is_rosbag2(found.kept):
                yield found
