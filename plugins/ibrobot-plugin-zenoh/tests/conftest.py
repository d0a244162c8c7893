"""Every test of this plugin leaves nothing open, but for what Zenoh opens once and keeps."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fake_runs import runs, site
from ibrobot_zenoh import reasons

from .pair import client, free_endpoint, made, router

__all__ = ["runs", "site"]


@pytest.fixture(scope="session", autouse=True)
def _zenoh_runs() -> None:
    """Zenoh's own threads run, with the files that they keep."""
    endpoint = free_endpoint()
    first, second = router(endpoint), client(endpoint)
    second.close()
    first.close()


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, a trial of why there is no connection may wait for long."""
    monkeypatch.setattr(reasons, "_TIMEOUT_S", 10.0)


@pytest.fixture
def brief_trials(_patience: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """For an other side that takes the connection and never answers: a longer trial finds nothing else."""
    monkeypatch.setattr(reasons, "_TIMEOUT_S", 0.2)


@pytest.fixture(autouse=True)
def _closed(no_leaks: None) -> Iterator[None]:
    """A test that failed leaves no session open."""
    yield
    while made:
        made.pop().close()
