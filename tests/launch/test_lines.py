"""Status lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ibrobot_core.cli.display import Lines
from ibrobot_core.run_hooks import RunHooks

if TYPE_CHECKING:
    from fake_runs import Runs


def test_rates_are_those_of_the_last_seconds(runs: Runs):
    runtime = runs.start(mode="teleop")
    display = Lines(runtime, RunHooks(), err=True)

    def seconds(duration: float) -> None:
        for _ in range(round(duration * 50)):
            runtime.step()
            display.sample()

    def rate(name: str) -> float:
        return float(display.rate(name).removesuffix(" Hz"))

    assert display.rate("top") == "- Hz"
    seconds(10.0)
    assert rate("top") == pytest.approx(50.0, rel=0.02)
    runs.parts.MADE["top"].read = lambda timeout_s: None
    seconds(4.0)
    assert rate("top") == 0.0
    assert rate("side") == pytest.approx(50.0, rel=0.02)
    line = display.line()
    assert "top 0.0 Hz" in line
    assert "loop 50.0 Hz" in line
