"""An explanation in words."""

from __future__ import annotations

from typing import Any

import pytest
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.report import Explanation
from made_runs import Run, window_of

SOMETIMES = ("guard", "operator", "without a plan", "velocity limit")
_CATCHES_UP = ("velocity limit",)
"""Commands that were held back return to the plan as fast as they may."""


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        pytest.param({}, set(), id="healthy"),
        pytest.param({"guarded": (0.3, 0.7)}, {"guard", *_CATCHES_UP}, id="guarded"),
        pytest.param({"takeover": (0.2, 0.6)}, {"operator", *_CATCHES_UP}, id="taken-over"),
        pytest.param({"latency_s": 1.1}, {"without a plan", *_CATCHES_UP}, id="plan-dry"),
        pytest.param({"velocity": 0.3}, {"velocity limit"}, id="slow-joints"),
    ],
)
def test_only_what_a_run_has_is_counted_between_answer_and_arm(changes: dict[str, Any], said: set[str]) -> None:
    window = window_of(Run(seed=9600, cameras=(), outcome="failure", **changes))
    text = " ".join(Explanation.of(window, Reference(), diagnose(window, Reference())).lines_between())
    assert "following 0.0" in text
    assert {each for each in SOMETIMES if each in text} == said
    assert " 0.0000 rad" not in text
    assert " 0.0 %" not in text
