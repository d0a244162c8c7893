"""The changelog says each thing once: merges of long-lived branches tend to bring old entries back."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def _entries(text: str) -> list[str]:
    """The beginning of each entry, without marks and line breaks."""
    entries = re.split(r"^- ", text, flags=re.MULTILINE)[1:]
    return [" ".join(re.sub(r"[`*]", "", entry).split())[:60] for entry in entries]


def test_entries_begin_differently() -> None:
    entries = _entries((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    assert [entry for entry in entries if entries.count(entry) > 1] == []


def test_repeated_entry_is_found() -> None:
    entries = _entries("- `ibrobot plan` plans\n  a path.\n- New.\n- ibrobot plan plans a path.\n")
    assert entries[0] == entries[2] != entries[1]
