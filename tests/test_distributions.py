"""The distributions of this repository: what the extras of `ibrobot` install."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = [ROOT, *sorted(ROOT.glob("plugins/*"))]


def project(folder: Path) -> dict[str, Any]:
    return dict(tomllib.loads((folder / "pyproject.toml").read_text())["project"])


EXTRAS: dict[str, list[str]] = project(ROOT / "plugins/ibrobot")["optional-dependencies"]


def brought(extra: str) -> set[str]:
    """The plugins that an extra brings, by way of other extras too."""
    found: set[str] = set()
    for requirement in EXTRAS[extra]:
        if inner := re.match(r"ibrobot\[(.*)\]", requirement):
            found |= {name for each in inner[1].split(",") for name in brought(each)}
        else:
            found |= set(re.findall(r"^[\w-]+", requirement))
    return found


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_versions_are_the_same(folder: Path) -> None:
    assert project(folder)["version"] == project(ROOT)["version"]


def test_all_brings_every_plugin_but_the_one_for_clusters() -> None:
    plugins = {folder.name for folder in FOLDERS if folder.name.startswith("ibrobot-plugin-")}
    assert brought("all") == plugins - {"ibrobot-plugin-ray"}


@pytest.mark.parametrize("page", ["README.md", "plugins/ibrobot/README.md"])
def test_every_extra_is_documented(page: str) -> None:
    text = (ROOT / page).read_text()
    assert [extra for extra in EXTRAS if f"ibrobot[{extra}]" not in text] == []


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_only_tests_need_the_conformance_suites(folder: Path) -> None:
    settings = project(folder)
    needed = [settings["dependencies"], *settings.get("optional-dependencies", {}).values()]
    assert [text for group in needed for text in group if "ibrobot-testing" in text] == []
