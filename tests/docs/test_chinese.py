"""Pages in Chinese have the commands, code, links and figures of their English pages."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(path for path in (*ROOT.glob("*.zh.md"), *ROOT.glob("docs/**/*.zh.md")) if "images" not in path.parts)
_BLOCK = re.compile(r"^```\w*\n.*?^```$", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"(?<=\S)\s+# .*$", re.MULTILINE)
"""What explains a command or a line of YAML."""
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_NUMBER = re.compile(r"\d+(?:[.,]\d+)*")


def english(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(".zh.md") + ".md")


def content(path: Path) -> dict[str, list[str] | Counter[str]]:
    """What both languages share: blocks of code in their order; code in lines, links and figures, counted."""
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"^.*English.* \| .*中文.*$", "", text, count=1, flags=re.MULTILINE)
    blocks = [_COMMENT.sub("", each) for each in _BLOCK.findall(text) if not each.startswith("```text")]  # drawings
    prose = _BLOCK.sub("", text).replace("\n", " ")
    code = [" ".join(each.split()) for each in re.findall(r"`[^`]+`", prose)]
    links = [link.replace(".zh.md", ".md") for link in _LINK.findall(prose) if not link.startswith("README")]
    plain = _LINK.sub("]", re.sub(r"`[^`]+`", "", prose))
    return {
        "blocks": blocks,
        "code": Counter(code),
        "links": Counter(links),
        "figures": Counter(_NUMBER.findall(plain)),
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
@pytest.mark.parametrize("kind", ["blocks", "code", "links", "figures"])
def test_both_languages_have_the_same(page: Path, kind: str) -> None:
    assert content(page)[kind] == content(english(page))[kind]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_each_page_names_the_other_language(page: Path) -> None:
    assert f"[English]({english(page).name})" in page.read_text(encoding="utf-8")
    assert f"[中文]({page.name})" in english(page).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_headings_and_rows_are_as_many(page: Path) -> None:
    def shape(path: Path) -> list[str]:
        lines = _BLOCK.sub("", path.read_text(encoding="utf-8")).splitlines()
        return [re.match(r"#+|\|", line)[0] for line in lines if re.match(r"#+ |\|", line)]  # type: ignore[index]

    assert shape(page) == shape(english(page))


def test_the_pages_for_the_first_hour_are_there() -> None:
    assert {path.name for path in PAGES} >= {"README.zh.md", "first-pick.zh.md", "so101-station.zh.md"}
