"""A takeover and a handback with each device that can intervene; `benchmarks/takeovers.py` makes a hundred."""

from __future__ import annotations

from pathlib import Path

import pytest
import takeovers
from ibrobot_testing.site import made_up_site

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("device", list(takeovers.PERSONS))
def test_a_takeover_is_smooth_labelled_and_recorded(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wander.py").write_text(takeovers.WANDER)
    with made_up_site(tmp_path / "site", tmp_path, monkeypatch) as site:
        site.add("wander", "wander.py")
        found = takeovers.measure(device, takeovers=1, seed=3)
    assert takeovers.is_good(found), found
    assert found["intervention_rows"] > 5
