"""Test plugins for tests of complete runs, installed for this process and its children."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import invalidate_caches
from importlib.metadata import EntryPoint, distributions
from pathlib import Path

import attrs
import pytest

from ibrobot_core.app import installed_plugins


@attrs.define
class Site:
    """A folder on the import path with distributions of test plugins.

    Args:
        folder: folder of the distributions.
        sources: where `add` finds its sources.
    """

    folder: Path
    sources: Path
    modules: list[str] = attrs.field(factory=list, init=False)
    """Names of the modules added."""

    def add(self, distribution: str, source: str | Path) -> None:
        """Install version 1.0 of `distribution`: a copy of one module, named in its entry point.

        Args:
            distribution: its name, also of the module.
            source: a file in `sources`, or an absolute path.
        """
        module = distribution.replace("-", "_")
        shutil.copyfile(self.sources / source, self.folder / f"{module}.py")
        metadata = self.folder / f"{module}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(f"[ibrobot]\n{module} = {module}\n")
        self.modules.append(module)
        # Python rereads a folder only if its time stamp has changed, which does not happen within a few milliseconds.
        invalidate_caches()

    def entry_points(self) -> list[EntryPoint]:
        """The entry points of the added distributions only."""
        return [entry for distribution in distributions(path=[str(self.folder)]) for entry in distribution.entry_points]


@contextmanager
def made_up_site(folder: Path, sources: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """An empty `Site`, whose plugins `installed_plugins()` discovers, and forgets at the end.

    Args:
        folder: where to make it.
        sources: where `Site.add` finds its sources.
        monkeypatch: puts the import path back.
    """
    site = Site(folder, sources)
    folder.mkdir()
    with monkeypatch.context() as until_the_end:
        until_the_end.syspath_prepend(str(folder))
        until_the_end.setenv("PYTHONPATH", str(folder))
        installed_plugins.cache_clear()
        yield site
    installed_plugins.cache_clear()  # the folder is no longer on the path: nothing after this finds its plugins
    for module in site.modules:
        sys.modules.pop(module, None)
