"""`ibrobot doctor` says whether the disk has room for recordings."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import pytest
from ibrobot_data import ibrobot_doctor


@pytest.mark.parametrize(("free", "ok"), [(1_000_000, False), (5_000_000_000, True)])
def test_disk(monkeypatch: pytest.MonkeyPatch, free: int, ok: bool) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    (check,) = ibrobot_doctor()

    assert check.ok is ok
    assert "2 GB" in check.remedy
    assert f"{free / 1e9:.1f} GB free" in check.found
