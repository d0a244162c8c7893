"""The commands that change episodes: `ibrobot episodes mark`, `trim`, `delete`, `trash` and `repair`."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path

import click

from ibrobot_core.api import EpisodeSummary, RecorderError
from ibrobot_core.app import Command, Declined, Failed, InUse, declared, echo, emit, wrong_input
from ibrobot_mcap import DELETE, LIST_TRASH, MARK, REPAIR, TRIM
from ibrobot_mcap.changes import (
    Changed,
    DeleteOptions,
    InTrash,
    MarkOptions,
    RepairOptions,
    TrashOptions,
    TrimOptions,
)


@click.command()
@declared(MARK)
@wrong_input()
def mark(options: MarkOptions, events: bool) -> None:
    """Set the OUTCOME of EPISODES, e.g. after a repair. The episode records that its outcome was set by hand."""
    from ibrobot_mcap.bag_metadata import set_custom
    from ibrobot_mcap.commands.find_episodes import opened
    from ibrobot_mcap.metadata import MARKED, OUTCOME
    from ibrobot_mcap.owning import owning

    for episode in options.episodes:
        with owning(episode, "is being marked"):
            with opened(episode) as reader:
                whole = episode.is_dir() and reader.finished and not reader.short()
            if not whole:
                raise RecorderError(f"{episode}: is unfinished, or lacks messages; run `ibrobot episodes repair` first")
            set_custom(episode, {OUTCOME: options.outcome, MARKED: "true"})
        _report(MARK, Changed(str(episode), options.outcome), events=events)


@click.command()
@declared(TRIM)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The new episode.")
@wrong_input()
def trim(options: TrimOptions, output: Path | None, events: bool) -> None:
    """Copy a part of an EPISODE to a new one.

    Times are in seconds from its first message. Without the end of the episode, the outcome is unknown: set it with
    `mark`. The last message of a latched topic before this part is kept, because a late subscriber would have received
    it. After --in-place, `ibrobot episodes trash --restore` puts the original back.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.find_episodes import duration_s, opened, stated_outcome_text

    episode, begin_s, end_s = options.episode, options.begin_s, options.end_s
    if options.in_place == (output is not None):
        raise click.UsageError("give either --output or --in-place")
    with opened(episode):  # raises the error for what is not an episode
        pass
    if output is None:
        made, trashed = trash.trim(episode, begin_s, end_s)
        if not events:
            echo(f"to undo: ibrobot episodes trash {episode.parent} --restore {trashed.id}", err=True)
    else:
        made = trash.copy_part(episode, output, begin_s, end_s)
    count = sum(topic.count for topic in made.topics.values())
    what = f"{count} messages, {duration_s(made):.2f} s{stated_outcome_text(made)}"
    _report(TRIM, Changed(str(made.path), what), events=events)


@click.command()
@declared(DELETE)
@wrong_input()
def delete(options: DeleteOptions, events: bool) -> None:
    """Delete EPISODES after asking. Other folders are never deleted.

    After --to-trash, `ibrobot episodes trash --restore` brings them back.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.find_episodes import size_of, size_text

    for episode in options.episodes:
        trash.check_is_episode(episode)
    for episode in options.episodes:
        if options.to_trash:
            trashed = trash.discard(episode)
            if not events:
                echo(f"to undo: ibrobot episodes trash {episode.parent} --restore {trashed.id}", err=True)
            _report(DELETE, Changed(str(episode), f"moved to {trash.TRASH}"), events=events)
            continue
        if not (options.yes or _confirmed(f"delete {episode} ({size_text(size_of(episode))})?")):
            raise Declined
        trash.delete(episode)
        _report(DELETE, Changed(str(episode), "deleted"), events=events)


@click.command("trash")
@declared(LIST_TRASH)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@wrong_input()
def trash_command(options: TrashOptions, as_json: bool, events: bool) -> None:
    """List, restore or delete episodes in the trash of PATH.

    The trash has deleted episodes and the originals of trimmed ones; newest last.

    PATH is a folder of datasets (by default `episodes`), a dataset, or the folder of its episodes.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.find_episodes import size_of, size_text

    path, restore, empty = options.path, options.restore, options.empty
    if restore is not None and empty:
        raise click.UsageError("give either --restore or --empty")
    if not path.is_dir():
        raise RecorderError(f"{path}: there is no such folder")
    originals = trash.trashed_in(path)
    if restore is not None:
        original = next((each for each in originals if each.id == restore), None)
        if original is None:
            known = ", ".join(each.id for each in originals) or "nothing"
            raise RecorderError(f"{path}: its trash has no {restore!r}; it has {known}")
        _report(LIST_TRASH, Changed(str(trash.restore(original)), "restored"), events=events)
        return
    sizes = [size_of(each.kept) for each in originals]
    if empty:
        if originals and not (
            options.yes or _confirmed(f"delete {len(originals)} ({size_text(sum(sizes))}) for good?")
        ):
            raise Declined
        _report(LIST_TRASH, Changed(str(path), f"deleted {len(trash.empty(path))} for good"), events=events)
    elif events:
        for each, size in zip(originals, sizes, strict=True):
            emit(LIST_TRASH, InTrash(id=each.id, done=each.done, path=str(each.origin), size_bytes=size))
    elif as_json:
        rows = [
            {"id": each.id, "done": each.done, "path": str(each.origin), "bytes": size}
            for each, size in zip(originals, sizes, strict=True)
        ]
        echo(json.dumps(rows, indent=2))
    else:
        for each, size in zip(originals, sizes, strict=True):
            echo(f"{each.id}  {each.done:<8}  {size_text(size):>8}  {each.origin}")


@click.command()
@declared(REPAIR)
@wrong_input()
def repair(options: RepairOptions, events: bool) -> None:
    """Repair unfinished or incomplete episodes in PATH.

    It writes index and metadata.yaml for the readable part. The episode records the missing messages, and `verify`
    reports them. The outcome becomes unknown, since the end may be missing: look at the episode, and set it with
    `mark`. The original is removed only after the new episode has been read back and has all its messages.
    Interrupted trims, repairs and deletions are finished.
    """
    from ibrobot_mcap import rewrite
    from ibrobot_mcap.commands.find_episodes import duration_s, episodes_in
    from ibrobot_mcap.owning import interrupted, owning

    path, failed = options.path, 0
    for episode in interrupted(path):
        with suppress(InUse), owning(episode, "is being repaired"):
            _report(REPAIR, Changed(str(episode), "an interrupted change is finished"), events=events)
    for episode in episodes_in(path):
        try:
            made = rewrite.repair(episode)
        except (RecorderError, InUse) as error:
            failed += 1
            if events:
                emit(REPAIR, Failed(str(error)))
            else:
                echo(f"error: {error}", err=True)
            continue
        what = "is whole"
        if made is not None:
            count = sum(topic.count for topic in made.topics.values())
            what = f"repaired, {count} messages, {duration_s(made):.2f} s{_description(made)}"
        _report(REPAIR, Changed(str(episode), what), events=events)
    if failed:
        raise SystemExit(1)


def _description(summary: EpisodeSummary) -> str:
    """A remark on missing messages and the former outcome."""
    from ibrobot_mcap.commands.find_episodes import stated_outcome_text

    missing = sum(topic.missing for topic in summary.topics.values())
    return (f", {missing} are missing" if missing else "") + stated_outcome_text(summary)


def _report(command: Command, change: Changed, *, events: bool) -> None:
    """Print a change."""
    if events:
        emit(command, change)
    else:
        echo(change.shown().text)


def _confirmed(question: str) -> bool:
    """Ask a yes/no question.

    Raises:
        click.UsageError: if standard input has no answer.
    """
    try:
        return click.confirm(question)
    except click.Abort:
        if sys.stdin.isatty():
            raise
        message = f"{question} Standard input has no answer: run it in a terminal, or give --yes"
        raise click.UsageError(message) from None
