"""Fixtures of all tests of core."""

from __future__ import annotations

import pytest
from fake_runs import site

from ibrobot_core import safe_output

__all__ = ["site"]


@pytest.fixture(autouse=True)
def no_secrets_of_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process hides its secrets wherever they come; here each test is a process."""
    monkeypatch.setattr(safe_output, "_secrets", set())
