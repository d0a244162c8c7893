"""`ibrobot episodes trash`."""

from __future__ import annotations

import json

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import Declined, declared, echo, emit, wrong_input
from ibrobot_mcap import LIST_TRASH
from ibrobot_mcap.changes import Changed, InTrash, TrashOptions
from ibrobot_mcap.commands.report import report


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
    from ibrobot_mcap.commands.ask import confirmed
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
        report(LIST_TRASH, Changed(str(trash.restore(original)), "restored"), events=events)
        return
    sizes = [size_of(each.kept) for each in originals]
    if empty:
        if originals and not (options.yes or confirmed(f"delete {len(originals)} ({size_text(sum(sizes))}) for good?")):
            raise Declined
        report(LIST_TRASH, Changed(str(path), f"deleted {len(trash.empty(path))} for good"), events=events)
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
