"""Which command is the action of a row: the one in effect, or the first after it."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_data.ticks import Ticks
from ibrobot_mcap.reader import Rosbag2Reader
from recordings import CONTRACT, record

from ibrobot_core.contract.specs import Contract

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bag") / "episode_000001"
    record(folder, 3, 0.9)
    return folder


def aligned(align: str) -> Contract:
    (action,) = CONTRACT.action_parts
    cameras = ("observation.images.top", "observation.images.wrist")
    parts = tuple(part for part in CONTRACT.observation_parts if part.key not in cameras)
    return attrs.evolve(CONTRACT, observation_parts=parts, action_parts=(attrs.evolve(action, align=align),))


def read(bag: Path, align: str) -> tuple[list[Any], list[Any], int]:
    """Rows, commands with their receipt [ns], and the first tick [ns]."""
    reader = Rosbag2Reader(bag)
    try:
        rows = list(Ticks(reader, aligned(align), "refuse"))
        commands = [(item.received_ns, item.message) for item in reader.messages({"/commands"})]
        return rows, commands, reader.summary().start_ns
    finally:
        reader.close()


def test_the_next_command_is_the_first_that_was_received_after_the_tick(bag: Path) -> None:
    rows, commands, first_ns = read(bag, "next")
    stamps = [stamp for stamp, _ in commands]
    step_ns = CONTRACT.step_ns
    ticks = [first_ns + number * step_ns for number in range(100) if first_ns + number * step_ns < stamps[-1]]
    assert len(ticks) - 2 <= len(rows) <= len(ticks), "up to the last tick that a command follows"
    for row, t_ns in zip(reversed(rows), reversed(ticks), strict=False):
        _, message = commands[bisect_right(stamps, t_ns)]
        np.testing.assert_array_equal(row["action"], message.data.astype(np.float32))


def test_a_command_in_effect_is_the_newest_by_the_tick(bag: Path) -> None:
    held, _, _ = read(bag, "hold")
    following, _, _ = read(bag, "next")
    assert not np.array_equal(held[5]["action"], following[5]["action"])


def test_only_another_alignment_than_the_default_changes_the_fingerprint() -> None:
    assert "align" not in aligned("hold").canonical()["action"][0]
    assert aligned("next").fingerprint() != aligned("hold").fingerprint()
    again = Contract.from_canonical(aligned("next").canonical())
    assert again.fingerprint() == aligned("next").fingerprint()
    assert "align: next" in aligned("next").difference(aligned("hold"))
