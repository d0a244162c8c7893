"""The task that `identify --excite` performs is as long as asked, and one that tasks may be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from ibrobot_mujoco.identification import excitation
from ibrobot_mujoco.so101 import so101

ARM = list(so101().joint_names[:-1])


@pytest.mark.parametrize("minutes", [0.5, 1, 3, 5, 10, 15])
def test_excitation_lasts_as_long_as_asked(minutes: float) -> None:
    """A task has at most 200 steps, which five minutes of single motions exceed."""
    rounds = excitation._units(so101(), ARM, [("gripper_action", "gripper")], np.random.default_rng(0))
    kept = list(excitation._limited(rounds, 60 * minutes))
    assert sum(each.seconds for each in kept) == pytest.approx(60 * minutes, abs=10)
    steps = list(excitation._joined(kept))
    assert 0 < len(steps) <= 199
    assert moves(steps) == sum("move" in each.alternatives[0] for each in kept)


def moves(steps: list[dict[str, Any]]) -> int:
    """Number of motions that are done if the first alternatives succeed."""
    return sum("move" in each for step in steps for each in _first(step))


def _first(step: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield from step["alternatives"][0] if "alternatives" in step else [step]
