"""Folders of ROS packages that a URDF or xacro file names, on machines without ROS too."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import attrs

from ibrobot_core.api import HardwareError

_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")


@attrs.frozen
class Packages:
    """Where the packages are that one file names."""

    file: Path
    """The URDF or xacro file; packages are looked for in the folders above it."""
    folders: Mapping[str, Path] = attrs.field(factory=dict)
    """Package -> folder, as the user says."""

    def find(self, name: str) -> Path:
        """The folder of a package.

        A folder is that of the package if it has its name, or a `package.xml` with its name. Looked for are the folders
        above the file, those beside them, and what ROS has installed.

        Raises:
            HardwareError: if there is none.
        """
        if name in self.folders:
            return self.folders[name]
        folder = next((each for each in self._candidates(name) if each.is_dir()), None)
        if not name or folder is None:
            raise HardwareError(
                f"no folder of the package {name!r} is above or beside {self.file}: "
                f"give --package {name or 'NAME'}=FOLDER"
            )
        return folder

    def _candidates(self, name: str) -> Iterator[Path]:
        above = self.file.resolve().parents
        for folder in above:
            if folder.name == name or _package_name(folder) == name:
                yield folder
        if "/" not in name and name not in ("", ".", ".."):
            yield from (folder / name for folder in above)
            yield from (each for folder in above[:4] for each in _folders(folder) if _package_name(each) == name)
            for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
                yield Path(prefix) / "share" / name


def _package_name(folder: Path) -> str:
    """The name in the `package.xml` of a folder; empty without one."""
    try:
        match = _NAME.search((folder / "package.xml").read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return ""
    return match[1] if match else ""


def _folders(folder: Path) -> list[Path]:
    try:
        return sorted(each for each in folder.iterdir() if each.is_dir())
    except OSError:
        return []
