"""The example of the tutorial: it is found, described and made as any plugin, and the pages show it as it is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from ibrobot_testing import host_context

from ibrobot_core.plugins import discover

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

EXAMPLE = Path(__file__).parent / "ibrobot-plugin-wave"
ROOT = Path(__file__).parents[2]


def test_it_is_found_through_its_entry_point(site: Site) -> None:
    site.add("ibrobot-plugin-wave", EXAMPLE / "ibrobot_wave/__init__.py")
    registry = discover(site.entry_points())
    assert registry.failures == []
    descriptor = registry.find("teleop", "wave")
    assert descriptor.summary == "waves with one joint"
    teleop = descriptor.make(descriptor.options(joint="gripper"), host_context())
    teleop.connect()
    teleop.disconnect()


def test_options_are_checked() -> None:
    from ibrobot_wave import WaveOptions

    with pytest.raises(ValueError, match="3 is too large, must be at most 1 rad"):
        WaveOptions(amplitude=3)


def test_pyproject_names_the_module() -> None:
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["ibrobot"] == {"wave": "ibrobot_wave"}


@pytest.mark.parametrize("path", sorted(EXAMPLE.rglob("*.py")), ids=lambda path: path.name)
def test_it_imports_core_through_its_api_alone(path: Path) -> None:
    imported = re.findall(r"^(?:from|import) (ibrobot_core[\w.]*)", path.read_text(), re.MULTILINE)
    assert set(imported) <= {"ibrobot_core.api", "ibrobot_core.app"}


def test_readme_shows_the_plugin_as_it_is() -> None:
    assert (EXAMPLE / "ibrobot_wave/__init__.py").read_text().strip() in (ROOT / "README.md").read_text()


def typed(folder: Path) -> None:
    """Put the files that the tutorial shows into an empty folder, each where the page says."""
    page = (ROOT / "docs/tutorials/write-a-plugin.md").read_text()
    listed = re.findall(r"^[\w./]+\.(?:toml|py)$", page, re.MULTILINE)
    shown = [
        (ROOT / "docs/tutorials" / each).resolve()
        for each in re.findall(r"^\[`[\w./]+`\]\((\S+)\)$", page, re.MULTILINE)
    ]
    assert [str(path.relative_to(EXAMPLE)) for path in shown] == listed
    for path in shown:
        target = folder / path.relative_to(EXAMPLE)
        target.parent.mkdir(exist_ok=True)
        target.write_text(path.read_text())


@pytest.mark.integration
def test_the_tutorial_works_as_typed_and_names_the_mistake_that_it_invites(tmp_path: Path) -> None:
    typed(tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    first = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert first.returncode == 0, first.stdout
    module = tmp_path / "ibrobot_wave/__init__.py"
    module.write_text(
        re.sub(r"    @override\n    def activate\(.*?(?=    @override)", "", module.read_text(), flags=re.DOTALL)
    )
    again = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert again.returncode == 1
    assert "wrist_flex jumps from -0.555 to 0.0" in again.stdout
