"""Fakes of what plugins add to a run or to the command line: sections, terminals, commands, command sources."""

from __future__ import annotations

import logging
import sys
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from queue import SimpleQueue
from typing import override

import attrs
import numpy as np

from ibrobot_core.api import Int32, option
from ibrobot_core.app import (
    CONTROL,
    ControlMode,
    LaunchRequest,
    LogFormatter,
    NoRequest,
    RequestError,
    RunDisplay,
    RunHooks,
    RunOptions,
    RunTerminal,
    Runtime,
    RunView,
    Service,
    SessionWorker,
    SourceWorker,
    StreamingRun,
    echo,
    run_robot,
)


class FakeSection(SessionWorker):
    """Counts the messages on `/joint_states`, and publishes the count.

    Args:
        session: the run.
        every: messages between two counts.
    """

    def __init__(self, session: RunView, every: int = 1) -> None:
        super().__init__(session, "fake", "counts joint states on /fake/count", (CONTROL,))
        self._every = every
        self._service = Service("/fake/reset", NoRequest, str, "Count from 0 again.")
        self._count = 0

    @override
    def setup(self) -> None:
        self._states = self.session.bus.subscribe("/joint_states")
        self.on_end.callback(self._states.close)
        self.session.bus.serve(self._service, self._reset)
        self.on_end.callback(self.session.bus.unserve, self._service)

    @override
    def work(self, timeout_s: float) -> None:
        if self._states.get(timeout_s) is not None:
            self._count += 1
            if self._count % self._every == 0:
                self.session.bus.publish("/fake/count", Int32(self._count))

    def _reset(self, request: NoRequest) -> str:
        self._count = 0
        return "counting from 0"


class FakeTerminal(RunTerminal):
    """Reads no keys, and prints which components start."""

    def __init__(self) -> None:
        self.closed = False

    @override
    def subscribe(self) -> SimpleQueue[str]:
        return SimpleQueue()

    @override
    def suspended(self) -> AbstractContextManager[None]:
        return nullcontext()

    @override
    def close(self) -> None:
        self.closed = True

    @override
    def __exit__(self, *raised: object) -> None:
        self.close()

    @override
    def display(self, runtime: Runtime, hooks: RunHooks, stack: ExitStack, *, err: bool) -> RunDisplay:
        return _Starts(runtime, err)


class _Starts(RunDisplay):
    """The components of a run as they start, and its log."""

    def __init__(self, runtime: Runtime, err: bool) -> None:
        super().__init__(runtime.session)
        self._err = err
        self.log = logging.StreamHandler(sys.stderr)
        self.log.setFormatter(LogFormatter("%(message)s"))

    @override
    def starting(self, component: str) -> None:
        echo(f"starting {component}", err=self._err)

    @override
    def show(self) -> None:
        self.sample()


@attrs.frozen(kw_only=True)
class FakeCommand:
    """Count the lines of FILE."""

    file: Path = option(typed="FILE", help="the file")
    blank: bool = option(False, help="whether empty lines count, too")

    def __call__(self) -> dict[str, int]:
        """Count them."""
        try:
            lines = self.file.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise RequestError(f"{self.file}: cannot be read: {error}") from None
        return {"lines": sum(self.blank or bool(line.strip()) for line in lines)}

    def show(self, counted: dict[str, int]) -> None:
        """Print the number."""
        echo(str(counted["lines"]))


@attrs.frozen(kw_only=True)
class FakeSourceCommand(RunOptions):
    """Move the first joint of a robot to and fro."""

    times: int = option(1, gt=0, help="how often")

    def __call__(self) -> None:
        """Run the robot."""
        request = LaunchRequest(self.lockstep, source=lambda session, mode: FakeSway(session, mode, self.times))
        run_robot(self.load(), request, headless=self.headless, as_json=self.as_json)


class FakeSway(SourceWorker):
    """Sends the setpoints of the whole motion at once, and ends the run after it."""

    session: StreamingRun
    autonomous = True

    def __init__(self, session: StreamingRun, mode: ControlMode, times: int) -> None:
        super().__init__(session, mode, "sways")
        self._times = times
        self._end_ns = 0

    @override
    def begin_mode(self, seed: int) -> None:
        start, step_ns = self.session.measured(), 20_000_000
        phases = np.linspace(0.0, 2 * np.pi * self._times, 100 * self._times)
        way = np.tile(start.position, (len(phases), 1))
        way[:, 0] += 0.1 * np.sin(phases)
        self.session.send_plan(start.stamp_ns, step_ns, self.session.config.robot.joint_names, way)
        self._end_ns = start.stamp_ns + len(way) * step_ns

    @override
    def work(self, timeout_s: float) -> None:
        self.pause(timeout_s)
        with self.lock:
            if self.active and self.session.clock.now_ns() >= self._end_ns:
                self.session.finish()


def fake_config() -> Path:
    """The robot YAML."""
    return Path(__file__).with_name("fake.yaml")
