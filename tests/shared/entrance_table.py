"""The table of entrances to motion in `docs/explanation/safety.md`, as rows."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import attrs

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "safety.md"
HEADING = "## Every entrance to motion"
COLUMNS = ("world", "guard", "silence", "time", "numbers", "STOP", "older", "caller dies")


@attrs.frozen
class Row:
    """A row: the names of entrances, and their cells by column."""

    names: tuple[str, ...]
    cells: Mapping[str, str]


def read_table() -> tuple[Row, ...]:
    """The rows of the page, whose first cells name entrances in backquotes."""
    section = PAGE.read_text(encoding="utf-8").partition(f"{HEADING}\n")[2].partition("\n## ")[0]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    head, _, *body = lines
    assert tuple(head[1:]) == COLUMNS
    return tuple(Row(tuple(re.findall("`(.+?)`", row[0])), dict(zip(COLUMNS, row[1:], strict=True))) for row in body)
