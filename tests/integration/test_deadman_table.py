"""Every device and every event: the arm holds within 0.3 s, and moves again only by a new press of the deadman."""

from __future__ import annotations

from pathlib import Path

import deadman_table
import pytest

pytestmark = pytest.mark.integration


SHORT = {
    "DualSense": "unplug",
    "Xbox on Bluetooth": "thaw",
    "SpaceMouse": "replug",
    "keyboard": "key repeat",
    "keyboard, kitty": "mode switch",
    "leader, hold": "freeze",
    "leader, toggle": "stop",
    "IMU": "fault",
    "page": "host paused",
    "headset": "thaw",
    "phone": "network cut",
    "twists": "network cut",
}
"""Each device, and each event; all sessions side by side run these cells, and the others are `long`."""
CELLS = [
    pytest.param(device, event, marks=[] if SHORT[device] == event else [pytest.mark.long])
    for device in deadman_table.PERSONS
    for event in deadman_table.EVENTS
]


@pytest.mark.parametrize(("device", "event"), CELLS)
def test_no_motion_without_a_new_press(device: str, event: str, tmp_path: Path) -> None:
    cell = deadman_table.measure(device, event, tmp_path)
    if cell is None:
        pytest.skip(f"{device} cannot have this event")
    assert cell.good, str(cell)
