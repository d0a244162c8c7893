"""The folders that the page may read and write; every path of a request is confined to them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from ibrobot_core.api import IbrobotError

_LONGEST, _LONGEST_NAME = 4000, 255
"""Longest path [characters], and longest name in it [bytes]."""

_PACKAGES = ("node_modules", "site-packages", "__pycache__")
"""Folders of installed packages."""


class Folders:
    """The opened folders.

    Args:
        paths: existing folders; relative paths of requests start at the first.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(path.resolve() for path in paths)

    @property
    def first(self) -> Path:
        """The folder in which jobs run."""
        return self.paths[0]

    def walk(self, depth: int, skipped: Collection[str] = ()) -> Iterator[tuple[Path, list[str], list[str]]]:
        """Walk the folders down to a depth, as `Path.walk` does, in the order of their names.

        It enters no links, hidden folders, folders of packages, and none with a `skipped` name. A caller that empties a
        list of subfolders enters none of these.
        """
        for opened in self.paths:
            for parent, folders, names in opened.walk():
                yield parent, folders, names
                entered = folders if len(parent.relative_to(opened).parts) < depth else ()
                out = {*_PACKAGES, *skipped}
                folders[:] = sorted(each for each in entered if not each.startswith(".") and each not in out)

    def find(self, text: str) -> Path:
        """The path that a request names, with links resolved; it need not exist.

        Raises:
            IbrobotError: if it is outside the opened folders.
        """
        if "\0" in text:
            raise IbrobotError("a path contains a zero character")
        if len(text) > _LONGEST or any(len(part.encode(errors="replace")) > _LONGEST_NAME for part in text.split("/")):
            raise IbrobotError(f"a path is too long: {text[:60]}…")
        path = (self.first / text).resolve()
        if not any(path.is_relative_to(folder) for folder in self.paths):
            opened = ", ".join(map(str, self.paths))
            raise IbrobotError(f"{text} is outside the opened folders ({opened}); open its folder: `ibrobot ui FOLDER`")
        return path

    def has(self, path: Path) -> bool:
        """Whether a path is a file of the opened folders, and no link out of them."""
        return path.is_file() and any(path.resolve().is_relative_to(folder) for folder in self.paths)

    def name(self, path: Path) -> str:
        """A path as the page shows it, and as `find` reads it: relative to the first folder, or absolute."""
        return str(path.relative_to(self.first)) if path.is_relative_to(self.first) else str(path)
