"""What is said of LeRobot's versions."""

from __future__ import annotations

import pytest
from ibrobot_lerobot import versions
from packaging.version import Version


@pytest.mark.parametrize("found", [*versions.TESTED, "0.4.0", "0.5.9", "0.6.1.post1", "0.6.2rc1"])
def test_tested_versions_are_known(found: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "installed", lambda: found)
    check = versions.check()
    assert check.ok
    assert check.found.startswith(f"{found}, tested with ")
    assert versions.untested(found) == ""


@pytest.mark.parametrize("found", ["0.3.3", "0.7.0", "1.0", "of unknown version", ""])
def test_other_versions_are_tried_with_a_warning(found: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "installed", lambda: found)
    check = versions.check()
    assert (check.ok, check.matters) == (False, False)
    assert f"LeRobot {found} is not one of the tested versions, 0.4.4, " in check.found


def test_lerobot_that_is_not_installed_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "installed", lambda: None)
    check = versions.check()
    assert (check.ok, check.matters, check.remedy) == (False, False, 'pip install "lerobot[dataset,training]"')


def test_versions_stand_in_order() -> None:
    assert list(versions.TESTED) == sorted(versions.TESTED, key=Version)
