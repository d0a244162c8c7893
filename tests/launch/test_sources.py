"""Command sources that a request brings, in place of what the YAML says of a mode."""

from __future__ import annotations

from typing import TYPE_CHECKING, override

import numpy as np

from ibrobot_core.component import SourceWorker
from ibrobot_core.launch.sources.teleop import TeleopSource

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.interfaces.run import StreamingRun
    from ibrobot_core.schema import ControlMode


class Raise(SourceWorker):
    """Moves the first joint to 0.3 rad."""

    session: StreamingRun

    def __init__(self, session: StreamingRun, mode: ControlMode) -> None:
        super().__init__(session, mode, "raises the first joint")

    @override
    def begin_mode(self, seed: int) -> None:
        start = self.session.measured()
        self.session.send_plan(start.stamp_ns + 500_000_000, 20_000_000, ("pan",), np.full((50, 1), 0.3))

    @override
    def work(self, timeout_s: float) -> None:
        self.pause(timeout_s)

    @override
    def facts(self) -> dict[str, str]:
        return {"raised": "pan"}


def test_source_of_the_request_commands_the_mode_in_which_the_run_begins(runs: Runs):
    runtime = runs.start(mode="idle", source=Raise)
    for _ in range(60):
        runtime.step()
    assert runtime.session.state is not None
    np.testing.assert_allclose(runtime.session.state.command[0], 0.3, atol=1e-6)
    assert runtime.summary()["raised"] == "pan"


def test_other_modes_have_the_source_of_the_yaml(runs: Runs):
    runtime = runs.start(mode="idle", source=Raise)
    runtime.switch_mode("teleop")
    assert isinstance(runtime.session.command_source, TeleopSource)
    runtime.switch_mode("idle")
    assert isinstance(runtime.session.command_source, Raise)


def test_it_takes_the_place_of_a_policy(runs: Runs):
    runtime = runs.make(mode="policy", source=Raise)
    names = [component.name for component in runtime.plan.components]
    assert "model:net" not in names
    assert "episodes" not in names
