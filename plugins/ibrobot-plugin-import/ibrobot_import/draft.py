"""The new file: nested values with comments -> YAML text, and the line of the old file for each of its lines."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import attrs

from ibrobot_import.source import From, Titled

ADDED = "added"
_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_./+-]*")
_WORDS = {"true", "false", "null", "yes", "no", "on", "off", "nan", "inf"}
_COLUMN = 60
"""Column of comments after short lines."""


@attrs.define
class Draft:
    """The text of the new file, and the lines that its lines come from."""

    lines: list[str] = attrs.field(factory=list)
    origins: list[int] = attrs.field(factory=list)
    """For each line, the line of the old file; 0 for none."""

    @property
    def text(self) -> str:
        """The file."""
        return "".join(f"{line}\n" for line in self.lines)

    def comment(self, text: str) -> None:
        """Add a line of comment; it stays a comment whatever the text has."""
        self.add(f"# {printable(text)}" if text else "#")

    def add(self, line: str, comment: str = "", origin: int = 0) -> None:
        """Add a line, with a comment."""
        self.lines.append(f"{line.ljust(_COLUMN)}  # {printable(comment)}" if comment else line)
        self.origins.append(origin)

    def block(self, value: Mapping[str, Any], indent: int = 0) -> None:
        """Add a mapping in block style, without keys whose value is None; `From` and plain lists in flow style."""
        for name, each in value.items():
            self._entry(f"{' ' * indent}{scalar(name)}:", each, indent)

    def _entry(self, head: str, value: Any, indent: int) -> None:
        if value is None:
            return
        note, origin = "", 0
        if isinstance(value, Titled):
            note, origin, value = value.comment, value.line, value.value
        if isinstance(value, From):
            self.add(f"{head} {flow(value.value)}", value.comment, value.line)
        elif isinstance(value, Mapping) and value:
            self.add(head, note, origin)
            self.block(value, indent + 2)
        elif isinstance(value, list) and any(isinstance(each, Mapping | From) for each in value):
            self.add(head, note, origin)
            for each in value:
                self._item(each, indent + 2)
        else:
            self.add(f"{head} {flow(value)}", note or ADDED, origin)

    def _item(self, value: Any, indent: int) -> None:
        if isinstance(value, From):
            self.add(f"{' ' * indent}- {flow(value.value)}", value.comment, value.line)
        elif isinstance(value, Mapping):
            start = len(self.lines)
            self.block(value, indent + 2)
            self.lines[start] = f"{' ' * indent}- {self.lines[start].lstrip()}"
        else:
            self.add(f"{' ' * indent}- {flow(value)}", ADDED)


def printable(text: str) -> str:
    """`text` in one line."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def flow(value: Any) -> str:
    """A value in one line of YAML."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{scalar(str(name))}: {flow(each)}' for name, each in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(flow(each) for each in value)}]"
    return scalar(value)


def scalar(value: Any) -> str:
    """A plain value as YAML that every reader reads as the same value."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else repr(value).replace("nan", ".nan").replace("inf", ".inf")
    if isinstance(value, int):
        return str(value)
    text = str(value)
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
        return text
    return f'"{"".join(map(_escaped, text))}"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    return character if character.isprintable() else f"\\U{ord(character):08x}"
