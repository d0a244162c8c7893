"""The commands that change episodes: `ibrobot episodes mark`, `trim`, `delete`, `trash` and `repair`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.ownership import InUse
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined, confirm

from ibrobot_core.api import EpisodeSummary, RecorderError, option
from ibrobot_core.app import Emit, Failed, RequestError, Unsuccessful, echo, wrong_input
from ibrobot_mcap.changes import OUTCOMES, Changed, InTrash


@attrs.frozen(kw_only=True)
class Mark:
    """Set the OUTCOME of EPISODES, e.g. after a repair. The episode records that its outcome was set by hand."""

    episodes: tuple[Path, ...] = option(typed="EPISODES", names="episodes", help="episodes to judge")
    outcome: str = option(typed="OUTCOME", choices=OUTCOMES, help="how they went")

    @wrong_input()
    def __call__(self, emit: Emit) -> None:
        from ibrobot_mcap.bag_metadata import set_custom
        from ibrobot_mcap.commands.find_episodes import opened
        from ibrobot_mcap.metadata import MARKED, OUTCOME
        from ibrobot_mcap.owning import owning

        for episode in self.episodes:
            with owning(episode, "is being marked"):
                with opened(episode) as reader:
                    whole = episode.is_dir() and reader.finished and not reader.short()
                if not whole:
                    raise RecorderError(
                        f"{episode}: is unfinished, or lacks messages; run `ibrobot episodes repair` first"
                    )
                set_custom(episode, {OUTCOME: self.outcome, MARKED: "true"})
            _report(emit, Changed(str(episode), self.outcome))


@attrs.frozen(kw_only=True)
class Trim:
    """Copy a part of an EPISODE to a new one.

    Times are in seconds from its first message. Without the end of the episode, the outcome is unknown: set it with
    `mark`. The last message of a latched topic before this part is kept, because a late subscriber would have received
    it. After --in-place, `ibrobot episodes trash --restore` puts the original back.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")
    begin_s: float = option(0.0, ge=0, unit="s", typed="--from", label="Begin", help="begin of the part")
    end_s: float | None = option(
        None, ge=0, unit="s", typed="--to", label="End", help="end of the part; by default the end of the episode"
    )
    in_place: bool = option(False, help="replace EPISODE; the original moves to .trash beside it")
    output: Path | None = option(None, typed="-o", label=None, help="the new episode")

    @wrong_input()
    def __call__(self, emit: Emit) -> None:
        from ibrobot_mcap import trash
        from ibrobot_mcap.commands.find_episodes import duration_s, opened, stated_outcome_text

        episode, begin_s, end_s = self.episode, self.begin_s, self.end_s
        if self.in_place == (self.output is not None):
            raise RequestError("give either --output or --in-place")
        with opened(episode):  # raises the error for what is not an episode
            pass
        if self.output is None:
            made, trashed = trash.trim(episode, begin_s, end_s)
            if emit is None:
                _say_undo(episode.parent, trashed.id)
        else:
            made = trash.copy_part(episode, self.output, begin_s, end_s)
        count = sum(topic.count for topic in made.topics.values())
        what = f"{counted(count, 'message')}, {duration_s(made):.2f} s{stated_outcome_text(made)}"
        _report(emit, Changed(str(made.path), what))


@attrs.frozen(kw_only=True)
class Delete:
    """Delete EPISODES after asking. Other folders are never deleted.

    After --to-trash, `ibrobot episodes trash --restore` brings them back.
    """

    episodes: tuple[Path, ...] = option(typed="EPISODES", names="episodes", help="episodes to delete")
    yes: bool = option(False, help="do not ask")
    to_trash: bool = option(False, help="move them to .trash beside them, without asking")

    @wrong_input()
    def __call__(self, emit: Emit) -> None:
        from ibrobot_mcap import trash
        from ibrobot_mcap.commands.find_episodes import size_of, size_text

        for episode in self.episodes:
            trash.check_is_episode(episode)
        for episode in self.episodes:
            if self.to_trash:
                trashed = trash.discard(episode)
                if emit is None:
                    _say_undo(episode.parent, trashed.id)
                _report(emit, Changed(str(episode), f"moved to {trash.TRASH}"))
                continue
            if not (self.yes or confirm(f"delete {episode} ({size_text(size_of(episode))})?", flag="--yes")):
                raise Declined
            trash.delete(episode)
            _report(emit, Changed(str(episode), "deleted"))


@attrs.frozen(kw_only=True)
class ListTrash:
    """List, restore or delete episodes in the trash of PATH.

    The trash has deleted episodes and the originals of trimmed ones; newest last.

    PATH is a folder of datasets (by default `episodes`), a dataset, or the folder of its episodes.
    """

    path: Path = option(Path("episodes"), typed="PATH", names="episodes", help="folder of episodes")
    restore: str | None = option(None, help="put back the one with this id")
    empty: bool = option(False, help="delete all of them for good, after asking")
    yes: bool = option(False, help="do not ask")

    @wrong_input()
    def __call__(self, emit: Emit) -> Sequence[Mapping[str, Any]] | None:
        from ibrobot_mcap import trash
        from ibrobot_mcap.commands.find_episodes import size_of, size_text

        path, restore, empty = self.path, self.restore, self.empty
        if restore is not None and empty:
            raise RequestError("give either --restore or --empty")
        if not path.is_dir():
            raise RecorderError(f"{path}: there is no such folder")
        originals = trash.trashed_in(path)
        if restore is not None:
            original = next((each for each in originals if each.id == restore), None)
            if original is None:
                known = ", ".join(each.id for each in originals) or "nothing"
                raise RecorderError(f"{path}: its trash has no {restore!r}; it has {known}")
            _report(emit, Changed(str(trash.restore(original)), "restored"))
            return None
        sizes = [size_of(each.kept) for each in originals]
        if empty:
            if originals and not (
                self.yes or confirm(f"delete {len(originals)} ({size_text(sum(sizes))}) for good?", flag="--yes")
            ):
                raise Declined
            _report(emit, Changed(str(path), f"deleted {len(trash.empty(path))} for good"))
            return None
        if emit is None:
            return [
                {"id": each.id, "done": each.done, "path": str(each.origin), "bytes": size}
                for each, size in zip(originals, sizes, strict=True)
            ]
        for each, size in zip(originals, sizes, strict=True):
            emit(InTrash(id=each.id, done=each.done, path=str(each.origin), size_bytes=size))
        return None

    def show(self, listed: Sequence[Mapping[str, Any]]) -> None:
        """Print a line for each."""
        from ibrobot_mcap.commands.find_episodes import size_text

        for each in listed:
            echo(f"{each['id']}  {each['done']:<8}  {size_text(each['bytes']):>8}  {each['path']}")


@attrs.frozen(kw_only=True)
class Repair:
    """Repair unfinished or incomplete episodes in PATH.

    It writes index and metadata.yaml for the readable part. The episode records the missing messages, and `verify`
    reports them. The outcome becomes unknown, since the end may be missing: look at the episode, and set it with
    `mark`. The original is removed only after the new episode has been read back and has all its messages.
    Interrupted trims, repairs and deletions are finished.
    """

    path: Path = option(typed="PATH", names="episodes", help="an episode, or a folder of them")

    @wrong_input()
    def __call__(self, emit: Emit) -> None:
        from ibrobot_mcap import rewrite
        from ibrobot_mcap.commands.find_episodes import duration_s, episodes_in
        from ibrobot_mcap.owning import interrupted, owning

        path, failed = self.path, 0
        for episode in interrupted(path):
            with suppress(InUse), owning(episode, "is being repaired"):
                _report(emit, Changed(str(episode), "an interrupted change is finished"))
        for episode in episodes_in(path):
            try:
                made = rewrite.repair(episode)
            except (RecorderError, InUse) as error:
                failed += 1
                if emit is not None:
                    emit(Failed(str(error)))
                else:
                    echo(f"error: {error}", err=True)
                continue
            what = "is whole"
            if made is not None:
                count = sum(topic.count for topic in made.topics.values())
                what = f"repaired, {counted(count, 'message')}, {duration_s(made):.2f} s{_description(made)}"
            _report(emit, Changed(str(episode), what))
        if failed:
            raise Unsuccessful


def _description(summary: EpisodeSummary) -> str:
    """A remark on missing messages and the former outcome."""
    from ibrobot_mcap.commands.find_episodes import stated_outcome_text

    missing = sum(topic.missing for topic in summary.topics.values())
    return (f", {missing} are missing" if missing else "") + stated_outcome_text(summary)


def _say_undo(folder: Path, number: str) -> None:
    echo(f"to undo: `ibrobot episodes trash {shlex.quote(str(folder))} --restore {number}`", err=True)


def _report(emit: Emit, change: Changed) -> None:
    """Print a change."""
    if emit is not None:
        emit(change)
    else:
        echo(change.shown().text)
