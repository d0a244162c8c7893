"""Pages are in plain technical English: words and phrases that readers have to read twice are out."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted({
    *ROOT.glob("*.md"),
    *(ROOT / "docs").glob("*/*.md"),
    *(ROOT / "docs").glob("*.md"),
    *(ROOT / "plugins").glob("*/README.md"),
} - {ROOT / f"docs/reference/{name}.md" for name in ("cli", "config", "options", "plugins")})  # fmt: skip
"""Written pages; the generated ones take their words from the code."""

OUT = {
    r"\b(?:is|are|was|were|be|been|being) told\b": "reports, prints, names, receives",
    r"\btold (?:of|by)\b": "reported, named",
    r"\banew\b": "again",
    r"\bthat there (?:is|are)\b": "available, installed",
    r"\bthere (?:is|are):": "available:",
    r"\bwith those\b": "together with the",
    r"\bepochs?\b": "generation; epoch means a pass over a dataset",
    r"\bFeeders?\b|\bWatchers?\b|\bDesks?\b": "the name that the code has now",
    r"\blooks? after\b": "manages, inspects",
    r"\bbags? of others\b": "bags from other software",
    r"\bcomes? to be\b": "is made, becomes",
    r"\bso soon\b": "as soon as",
    r"\bseen to\b|\bsees? to it\b": "ensures",
    r"\bwhich that is\b|\bwho that is\b": "name it",
}
"""Pattern -> what to write."""


def _prose(text: str) -> str:
    """The text without code, which quotes programs as they are; line numbers stay."""
    text = re.sub(
        r"^( *)```.*?^\1```", lambda block: re.sub(r"[^\n]", "", block[0]), text, flags=re.MULTILINE | re.DOTALL
    )
    text = re.sub(r"^    .*$", "", text, flags=re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_uses_plain_words(page: Path) -> None:
    found = []
    text = _prose(page.read_text(encoding="utf-8"))
    for pattern, instead in OUT.items():
        for match in re.finditer(pattern.replace(" ", r"\s+"), text):
            line = text.count("\n", 0, match.start()) + 1
            found.append(f"{page.relative_to(ROOT)}:{line}: {match[0]!r}: write {instead}")
    assert found == []


@pytest.mark.parametrize("text", ["An error is\ntold once.", "An epoch begins.", "The modes that there are."])
def test_words_that_are_out_are_found(text: str) -> None:
    assert any(re.search(pattern.replace(" ", r"\s+"), _prose(text)) for pattern in OUT)


def test_code_may_use_any_word() -> None:
    assert "told" not in _prose("Run `is told`:\n\n```text\nis told\n```\n\n    is told\n")
