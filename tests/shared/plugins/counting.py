"""A plugin with a job: `ibrobot count` has declared options and events, so that pages can run it, too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import override

import attrs
import click

from ibrobot_core.api import DatasetError, hookimpl, option
from ibrobot_core.app import Command, Event, Shown, declared, echo, emit


@attrs.frozen(kw_only=True)
class CountOptions:
    """What is counted."""

    folders: tuple[Path, ...] = option(argument=True, help="folders to look into")
    kind: str = option("all", choices={"all": "all files", "text": "texts"}, label="Files", help="files to count")
    at_least: int = option(0, ge=0, unit="bytes", label="Smallest size", more=True, help="size from which they count")


@attrs.frozen
class Counted(Event):
    """A folder is done."""

    folder: str = option(help="the folder")
    files: int = option(help="files in it")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.folder} has {self.files} files")


def _load() -> click.Command:
    return count


COUNT = Command("count", "Count files.", _load, CountOptions, (Counted,))


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot count`."""
    yield COUNT


@click.command()
@declared(COUNT)
def count(options: CountOptions, events: bool) -> None:
    """Count the files of FOLDERS."""
    for folder in options.folders:
        if not folder.is_dir():
            raise DatasetError(f"{folder}: is no folder; leave it out, or choose --kind text")
        suffixes = (".txt", ".md") if options.kind == "text" else ("",)
        found = [path for path in folder.iterdir() if path.is_file() and path.name.endswith(suffixes)]
        event = Counted(str(folder), sum(path.stat().st_size >= options.at_least for path in found))
        if events:
            emit(COUNT, event)
        else:
            echo(event.shown().text)
