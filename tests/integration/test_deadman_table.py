"""Every device and every event: the arm holds within 0.3 s, and moves again only by a new press of the deadman."""

from __future__ import annotations

from pathlib import Path

import deadman_table
import pytest

pytestmark = pytest.mark.integration


CELLS = [
    pytest.param(device, event, marks=[pytest.mark.long] if (row + column) % 4 else [])
    for row, device in enumerate(deadman_table.PERSONS)
    for column, event in enumerate(deadman_table.EVENTS)
]
"""Each device and each event is in several cells; all sessions side by side run a quarter of them."""


@pytest.mark.parametrize(("device", "event"), CELLS)
def test_no_motion_without_a_new_press(device: str, event: str, tmp_path: Path) -> None:
    cell = deadman_table.measure(device, event, tmp_path)
    if cell is None:
        pytest.skip(f"{device} cannot have this event")
    assert cell.good, str(cell)
