"""Executors of somebody else's plugin are driven by what their descriptor says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site


@pytest.fixture(autouse=True)
def plugin(site: Site) -> None:
    site.add("foreign-executors", "foreign_executors.py")


@pytest.mark.parametrize("behavior", ["hold", "relax"])
def test_setpoints_reach_a_streaming_executor_with_options_of_its_own(runs: Runs, behavior: str) -> None:
    runtime = runs.start(
        "executors.arm_position.type=nearest",
        "executors.arm_position.stiffness=2.0",
        f"contract.actions.0.safety_behavior={behavior}",
        mode="policy",
        episodes=1,
    )
    before = runtime.session.measured().position[0]
    for _ in range(25):
        runtime.step()
    assert abs(runtime.session.measured().position[0] - before) > 0.01
    assert runtime.session.config.executors["arm_position"].options.stiffness == 2.0
