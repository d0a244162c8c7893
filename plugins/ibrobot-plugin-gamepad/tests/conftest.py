"""A bus without devices in place of the machine's."""

from __future__ import annotations

import sys

import pytest

from .fake_hid import FakeHidapi


@pytest.fixture
def hidapi(monkeypatch: pytest.MonkeyPatch) -> FakeHidapi:
    fake = FakeHidapi()
    monkeypatch.setitem(sys.modules, "hidraw", fake)
    monkeypatch.setitem(sys.modules, "hid", fake)
    return fake
