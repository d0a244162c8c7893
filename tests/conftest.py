"""Fixtures of all tests of core."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_testing.site import Site, made_up_site

from ibrobot_core import safe_output


@pytest.fixture(autouse=True)
def no_secrets_of_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process hides its secrets wherever they come; here each test is a process."""
    monkeypatch.setattr(safe_output, "_secrets", set())


PLUGINS = Path(__file__).parent / "shared/plugins"
"""Made-up plugins, each a module."""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """An empty site, seen by this process and by those that it starts; `installed_plugins()` discovers again."""
    with made_up_site(tmp_path / "site", PLUGINS, monkeypatch) as site:
        yield site
