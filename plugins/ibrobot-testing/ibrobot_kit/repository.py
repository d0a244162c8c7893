"""ibrobot's own repository: what a new package in it needs beside its folder."""

from __future__ import annotations

import re
from pathlib import Path

import attrs

from ibrobot_core.app import RequestError


@attrs.frozen
class Repository:
    """A checkout."""

    root: Path

    @classmethod
    def around(cls, folder: Path) -> Repository | None:
        """The checkout whose folder of plugins this is; None for any other folder."""
        plugins = folder.resolve()
        root = plugins.parent
        is_one = plugins.name == "plugins" and (root / "ibrobot_core/hookspecs.py").is_file()
        return cls(root) if is_one else None

    def entered(self, package: str, summary: str) -> dict[Path, str]:
        """The files in which the packages of the repository are listed, with one more package.

        Args:
            package: its name.
            summary: what it offers.

        Returns:
            File -> its text.

        Raises:
            RequestError: if a list is not found.
        """
        row = f"| `{package}` | {summary} |"
        rows = r"(?:\| `ibrobot-plugin-[\w-]+` \|[^\n]*\n)+"
        added = {
            "pyproject.toml": (r"(?:ibrobot-[\w-]+ = \{[^\n]*\n)+", f"{package} = {{ workspace = true }}"),
            "plugins/ibrobot/pyproject.toml": (r"all = \[\n(?:    [^\n]*\n)+", f'    "{package}>=0.1,<0.2",'),
            "README.md": (rows, row),
            "README.zh.md": (rows, row),
        }
        texts: dict[Path, str] = {}
        for name, (lines, line) in added.items():
            file = self.root / name
            text = file.read_text(encoding="utf-8")
            if (match := re.search(f"^{lines}", text, re.MULTILINE)) is None:
                raise RequestError(f"{file}: has no list of packages, which would match {lines}")
            texts[file] = f"{text[: match.end()]}{line}\n{text[match.end() :]}"
        return texts
