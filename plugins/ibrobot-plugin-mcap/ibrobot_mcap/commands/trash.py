"""`ibrobot episodes trash`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import Declined, EpisodePath, echo, wrong_input


@click.command("trash")
@click.argument("path", type=EpisodePath(), default=Path("episodes"))
@click.option("--restore", metavar="ID", help="Put this one back, as it was.")
@click.option("--empty", is_flag=True, help="Delete all of them for good, after asking.")
@click.option("--yes", is_flag=True, help="Do not ask.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@wrong_input()
def trash_command(path: Path, restore: str | None, empty: bool, yes: bool, as_json: bool) -> None:
    """List, restore or delete episodes in the trash of PATH.

    The trash has deleted episodes and the originals of trimmed ones; newest last.

    PATH is a folder of datasets (by default `episodes`), a dataset, or the folder of its episodes.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.ask import agree
    from ibrobot_mcap.commands.find_episodes import size_of, told_size

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
        echo(f"{trash.restore(chosen)}: restored")
        return
    sizes = [size_of(each.kept) for each in found]
    if empty:
        if found and not (yes or agree(f"delete {len(found)} ({told_size(sum(sizes))}) for good?")):
            raise Declined
        echo(f"{path}: deleted {len(trash.empty(path))} for good")
    elif as_json:
        rows = [
            {"id": each.id, "done": each.done, "path": str(each.origin), "bytes": size}
            for each, size in zip(found, sizes, strict=True)
        ]
        echo(json.dumps(rows, indent=2))
    else:
        for each, size in zip(found, sizes, strict=True):
            echo(f"{each.id}  {each.done:<8}  {told_size(size):>8}  {each.origin}")
