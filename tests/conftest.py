"""Fixtures of all tests of core."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from importlib import invalidate_caches
from importlib.metadata import EntryPoint, distributions
from pathlib import Path

import attrs
import pytest

from ibrobot_core import outside
from ibrobot_core.plugins import installed_plugins


@pytest.fixture(autouse=True)
def no_secrets_of_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process hides its secrets wherever they come; here each test is a process."""
    monkeypatch.setattr(outside, "_secrets", set())


PLUGINS = Path(__file__).parent / "shared/plugins"
"""Made-up plugins, each a module."""


@attrs.define
class Site:
    """A folder on the import path, with made-up distributions that are plugins."""

    folder: Path
    modules: list[str] = attrs.field(factory=list)

    def add(self, distribution: str, source: str | Path) -> None:
        """Install version 1.0 of `distribution`: a copy of one module, named in its entry point.

        Args:
            distribution: its name, which the module gets too.
            source: a file in `tests/shared/plugins`, or an absolute path.
        """
        module = distribution.replace("-", "_")
        shutil.copyfile(PLUGINS / source, self.folder / f"{module}.py")
        metadata = self.folder / f"{module}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(f"[ibrobot]\n{module} = {module}\n")
        self.modules.append(module)
        # Python lists a folder again when its time stamp has changed, which it has not within some milliseconds.
        invalidate_caches()

    def entry_points(self) -> list[EntryPoint]:
        """The entry points of what was added, and of nothing else."""
        return [entry for found in distributions(path=[str(self.folder)]) for entry in found.entry_points]


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """An empty site, seen by this process and by those that it starts; `installed_plugins()` discovers again."""
    made = Site(tmp_path / "site")
    made.folder.mkdir()
    monkeypatch.syspath_prepend(str(made.folder))
    monkeypatch.setenv("PYTHONPATH", str(made.folder))
    installed_plugins.cache_clear()
    yield made
    installed_plugins.cache_clear()
    for module in made.modules:
        sys.modules.pop(module, None)
