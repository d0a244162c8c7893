"""Every device and every event: the arm holds within 0.3 s, and moves again only by a new press of the deadman."""

from __future__ import annotations

from pathlib import Path

import deadman_table
import pytest

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("event", deadman_table.EVENTS)
@pytest.mark.parametrize("device", deadman_table.PERSONS)
def test_no_motion_without_a_new_press(device: str, event: str, tmp_path: Path) -> None:
    cell = deadman_table.measure(device, event, tmp_path)
    if cell is None:
        pytest.skip(f"{device} cannot have this event")
    assert cell.good, str(cell)
