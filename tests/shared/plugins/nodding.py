"""A plugin with a command that runs a robot: it nods with one joint."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import hookimpl, option
from ibrobot_core.app import (
    Command,
    ControlMode,
    LaunchRequest,
    ModeOptions,
    SourceWorker,
    StreamingRun,
    run_robot,
)


class Nod(SourceWorker):
    """Moves a joint to and fro once, and ends the run."""

    session: StreamingRun
    autonomous = True

    def __init__(self, session: StreamingRun, mode: ControlMode, joint: str) -> None:
        super().__init__(session, mode, f"nods with {joint}")
        self._joint = joint
        self._end_ns = 0

    @override
    def begin_mode(self, seed: int) -> None:
        session = self.session
        start, step_ns = session.measured(), 20_000_000
        position = start.position[session.config.robot.indices((self._joint,))]
        way = position + 0.1 * np.sin(np.linspace(0.0, 2 * np.pi, 100))[:, np.newaxis]
        session.send_plan(start.stamp_ns, step_ns, (self._joint,), way)
        self._end_ns = start.stamp_ns + len(way) * step_ns

    @override
    def work(self, timeout_s: float) -> None:
        self.pause(timeout_s)
        with self.lock:
            if self.active and self.session.clock.now_ns() >= self._end_ns:
                self.session.finish()

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        return [("nodded", f"once, with {self._joint}")]

    @override
    def facts(self) -> dict[str, Any]:
        return {"nodded": self._joint}


@attrs.frozen(kw_only=True)
class NodOnce(ModeOptions):
    """Nod."""

    joint: str = option(help="the joint")

    def __call__(self) -> None:
        request = LaunchRequest(self.lockstep, source=lambda session, mode: Nod(session, mode, self.joint))
        robot = self.load(self.mode)
        run_robot(robot, request, headless=self.headless, dry_run=self.dry_run, as_json=self.as_json)


@hookimpl
def ibrobot_commands() -> Iterator[Command]:
    yield Command("nod", NodOnce)
