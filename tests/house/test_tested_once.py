"""What a plugin's own session runs is not run again in that of all plugins."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PLUGINS = Path(__file__).parents[2] / "plugins"
MARKED = [
    path for path in sorted(PLUGINS.glob("*/tests/**/test_*.py")) if "mark.integration" in path.read_text("utf-8")
]


@pytest.mark.parametrize("path", MARKED, ids=lambda path: f"{path.parts[-3]}/{path.name}")
def test_integration_tests_of_a_plugin_are_skipped_without_what_else_they_need(path: Path) -> None:
    assert re.search(r"skipif|importorskip|with_all", path.read_text("utf-8")), "no mark: its own session runs it"
