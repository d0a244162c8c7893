"""`ibrobot episodes trash`."""

from __future__ import annotations

import json

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import Declined, declared, echo, emit, wrong_input
from ibrobot_mcap import LIST_TRASH
from ibrobot_mcap.changes import Changed, InTrash, TrashOptions
from ibrobot_mcap.commands.tell import told


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
    from ibrobot_mcap.commands.ask import agree
    from ibrobot_mcap.commands.find_episodes import size_of, told_size

    path, restore, empty = options.path, options.restore, options.empty
    if restore is not None and empty:
        raise click.UsageError("give either --restore or --empty")
    if not path.is_dir():
        raise RecorderError(f"{path}: there is no such folder")
    found = trash.trashed_in(path)
    if restore is not None:
        chosen = next((each for each in found if each.id == restore), None)
        if chosen is None:
            known = ", ".join(each.id for each in found) or "nothing"
            raise RecorderError(f"{path}: its trash has no {restore!r}; it has {known}")
        told(LIST_TRASH, Changed(str(trash.restore(chosen)), "restored"), events=events)
        return
    sizes = [size_of(each.kept) for each in found]
    if empty:
        if found and not (options.yes or agree(f"delete {len(found)} ({told_size(sum(sizes))}) for good?")):
            raise Declined
        told(LIST_TRASH, Changed(str(path), f"deleted {len(trash.empty(path))} for good"), events=events)
    elif events:
        for each, size in zip(found, sizes, strict=True):
            emit(LIST_TRASH, InTrash(id=each.id, done=each.done, path=str(each.origin), size_bytes=size))
    elif as_json:
        rows = [
            {"id": each.id, "done": each.done, "path": str(each.origin), "bytes": size}
            for each, size in zip(found, sizes, strict=True)
        ]
        echo(json.dumps(rows, indent=2))
    else:
        for each, size in zip(found, sizes, strict=True):
            echo(f"{each.id}  {each.done:<8}  {told_size(size):>8}  {each.origin}")
