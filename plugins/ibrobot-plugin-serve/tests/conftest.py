"""Made-up plugins for this process and the model's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ibrobot_testing.site import Site, made_up_site


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """An empty site, seen by this process and by those that it starts."""
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        yield site
