"""A plugin with a job: `ibrobot count` has declared options and events, so that pages can run it, too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import override

import attrs

from ibrobot_core.api import DatasetError, hookimpl, option
from ibrobot_core.app import Command, Emit, Event, Shown, Unsuccessful, echo


@attrs.frozen
class Counted(Event):
    """A folder is done."""

    folder: str = option(help="the folder")
    files: int = option(help="files in it")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.folder} has {self.files} files")


@attrs.frozen(kw_only=True)
class Count:
    """Count the files of FOLDERS."""

    folders: tuple[Path, ...] = option(typed="FOLDERS", help="folders to look into")
    kind: str = option("all", choices={"all": "all files", "text": "texts"}, label="Files", help="files to count")
    at_least: int = option(0, ge=0, unit="bytes", label="Smallest size", more=True, help="size from which they count")

    def __call__(self, emit: Emit) -> list[Counted]:
        """Count them."""
        counts = []
        for folder in self.folders:
            if not folder.is_dir():
                raise DatasetError(f"{folder}: is no folder; leave it out, or choose --kind text")
            suffixes = (".txt", ".md") if self.kind == "text" else ("",)
            listed = [path for path in folder.iterdir() if path.is_file() and path.name.endswith(suffixes)]
            counts.append(Counted(str(folder), sum(path.stat().st_size >= self.at_least for path in listed)))
            if emit is not None:
                emit(counts[-1])
        if not any(each.files for each in counts):
            raise Unsuccessful(counts)
        return counts if emit is None else []

    def show(self, counts: list[Counted]) -> None:
        """Print a line for each folder."""
        for each in counts:
            echo(each.shown().text)


COUNT = Command("count", Count, "Count files.", (Counted,))


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot count`."""
    yield COUNT
