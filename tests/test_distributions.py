"""The distributions of this repository: the extras of `ibrobot`, and the lists that a new one must be in."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = [ROOT, *sorted(ROOT.glob("plugins/*"))]


def project(folder: Path) -> dict[str, Any]:
    return dict(tomllib.loads((folder / "pyproject.toml").read_text())["project"])


LOCAL = {project(folder)["name"] for folder in FOLDERS}
PLUGINS = {name for name in LOCAL if name.startswith("ibrobot-plugin-")}
SOURCES = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["uv"]["sources"]
README = (ROOT / "README.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()
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
    missing = PLUGINS - {"ibrobot-plugin-ray"} - brought("all")
    assert not missing, f"add {missing} to an extra in plugins/ibrobot/pyproject.toml"
    assert brought("all") == PLUGINS - {"ibrobot-plugin-ray"} | {"ibrobot-kinematics"}  # which is a plugin, too


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_what_a_distribution_needs_of_this_repository_is_a_source_of_the_workspace(folder: Path) -> None:
    settings = tomllib.loads((folder / "pyproject.toml").read_text())
    groups = (settings["project"].get("optional-dependencies", {}), settings.get("dependency-groups", {}))
    texts = [settings["project"]["dependencies"], *(texts for group in groups for texts in group.values())]
    names = {re.split(r"[\[<>=~! ;]", text)[0] for group in texts for text in group}
    missing = [f"{name} = {{ workspace = true }}" for name in sorted(names & LOCAL - set(SOURCES))]
    assert not missing, f"add {missing} to [tool.uv.sources] of pyproject.toml, and run `uv lock`"
    assert folder == ROOT or "sources" not in settings.get("tool", {}).get("uv", {}), "the root's sources are for all"


@pytest.mark.parametrize("name", sorted(LOCAL))
def test_the_readme_has_a_row_for_every_package(name: str) -> None:
    rows = re.findall(r"`([\w-]+)`", "".join(re.findall(r"^\| ((?:`[\w-]+`(?:, )?)+) \|", README, re.MULTILINE)))
    assert rows.count(name) == 1, f'add a row `{name}` to the table "Plugins here" of README.md'


def test_the_readme_names_every_scene() -> None:
    row = re.search(r"^\| `ibrobot-plugin-mujoco` \|.*$", README, re.MULTILINE)
    assert row is not None
    offers = json.loads((ROOT / "ibrobot_core/official_plugins.json").read_text())["ibrobot-plugin-mujoco"]
    assert [scene for scene in offers["scene"] if f"`{scene}`" not in row[0]] == [], "add it to the row in README.md"


def test_contributing_names_every_library_that_plugins_share() -> None:
    (rule,) = re.findall(r"the libraries that plugins share \((.*?)\)", CONTRIBUTING, re.DOTALL)
    libraries = {name for name in LOCAL if re.match("ibrobot-(?!plugin-|testing|gym|core)", name)}
    assert set(re.findall(r"`([\w-]+)`", rule)) == libraries, "correct the list in the rule `Layout` of CONTRIBUTING.md"


@pytest.mark.parametrize("page", ["README.md", "plugins/ibrobot/README.md"])
def test_every_extra_is_documented(page: str) -> None:
    text = (ROOT / page).read_text()
    assert [extra for extra in EXTRAS if f"ibrobot[{extra}]" not in text] == []


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_only_tests_need_the_conformance_suites(folder: Path) -> None:
    settings = project(folder)
    needed = [settings["dependencies"], *settings.get("optional-dependencies", {}).values()]
    assert [text for group in needed for text in group if "ibrobot-testing" in text] == []


@pytest.mark.parametrize("page", ["README.md", "README.zh.md", "docs/how-to/install.md"])
def test_pages_name_the_address_of_the_repository_once_it_has_one(page: str) -> None:
    """`Repository` of `[project.urls]` in pyproject.toml is that address; without it, no page may make one up."""
    address = project(ROOT).get("urls", {}).get("Repository")
    cloned = re.findall(r"^\s*\$ git clone (\S+)", (ROOT / page).read_text(), re.MULTILINE)
    assert set(cloned) == ({address} if address else set()), f"git clone {address}"
