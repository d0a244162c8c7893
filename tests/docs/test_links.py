"""Pages read well in a clone, without the site: links lead to files of the repository, and no page has a directive."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("api", "cli", "interfaces", "options", "testing")
MADE = (*(ROOT / "docs/reference" / name for name in PARTS), ROOT / "docs/plugins", ROOT / "docs/_build")
"""What only a build of the site has."""
PAGES = [
    page
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("plugins/*/README.md"))
    if not any(page.is_relative_to(folder) for folder in MADE)
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_of_the_repository(page: Path) -> None:
    text = re.sub(r"^```.*?^```|`[^`\n]+`", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    targets = re.findall(r"\]\((?!\w+:)([^)#\s]+)", text)
    missing = [target for target in targets if not (page.parent / target).exists()]
    made = [t for t in targets if any((page.parent / t).resolve().is_relative_to(folder) for folder in MADE)]
    assert (missing, made) == ([], [])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_no_page_has_a_directive(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"^(?:```|:::)\{.*|(?<![\w`$/])\{(?:py:)?[a-z]+\}`[^`]*`|^\([\w-]+\)=$", text, re.MULTILINE)
    assert found == []
