"""What shows a run on standard output: plain status lines, or the panel of a terminal that a plugin offers."""

from __future__ import annotations

import logging
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any, override

from ibrobot_core.control.core import EMERGENCY_STOP
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.run_hooks import RunHooks
from ibrobot_core.safe_output import LogFormatter, echo
from ibrobot_core.units import NS_PER_S

LOOP = ""
"""Name of the control loop, beside the names of sensors."""
_RECENT_NS = 3 * NS_PER_S
"""Time over which rates are measured [ns]."""
_SAMPLE_NS = NS_PER_S // 4
_PLAIN_PERIOD_S = 2.0
_COMMANDS = {
    "policy": "the policy commands",
    "operator": "THE OPERATOR COMMANDS",
    "handover": "holding for the handover",
}


class RunDisplay(ABC):
    """Shows a run while it goes on, with texts about it.

    Args:
        session: the run.

    Attributes:
        log: gets the messages of the run.
    """

    log: logging.Handler

    def __init__(self, session: Session) -> None:
        self.session = session
        self._samples: deque[tuple[int, dict[str, int]]] = deque()
        """Counts of the control loop and the sensors in the last seconds."""

    def starting(self, component: str) -> None:
        """A component starts."""

    def press(self, key: str, stops: int) -> None:
        """A key other than Esc was pressed, after so many emergency stops; called in a thread of its own."""

    @abstractmethod
    def show(self) -> None:
        """Show the present state; called several times per second, and in lockstep at every tick."""

    def sample(self) -> None:
        """Store the present counts; call it a few times per second."""
        session, now_ns = self.session, self.session.clock.now_ns()
        if self._samples and now_ns - self._samples[-1][0] < _SAMPLE_NS:
            return
        ticks = {LOOP: session.state.tick} if session.state is not None else {}
        self._samples.append((now_ns, {name: sensor.received for name, sensor in session.sensors.items()} | ticks))
        while len(self._samples) > 2 and now_ns - self._samples[1][0] >= _RECENT_NS:
            self._samples.popleft()

    def rate(self, name: str) -> str:
        """The rate of a sensor, or of `LOOP`, over the last seconds as text; `- Hz` before the second sample."""
        if len(self._samples) < 2:
            return "- Hz"
        (first_ns, first), (last_ns, last) = self._samples[0], self._samples[-1]
        return f"{(last.get(name, 0) - first.get(name, 0)) * NS_PER_S / (last_ns - first_ns):.1f} Hz"

    def loop_text(self) -> str:
        """Rate and lateness of the control loop."""
        loop = self.session.control.report["loop"]
        return (
            f"{self.rate(LOOP)}, late p50 {loop['lateness_p50_us']:.0f} us, "
            f"p99 {loop['lateness_p99_us']:.0f} us, missed {loop['missed']}"
        )

    def sensor_texts(self) -> list[str]:
        """Rate and age of each sensor."""
        return [
            f"{name} {self.rate(name)}" + (f", {age_s * 1e3:.0f} ms old" if (age_s := sensor.age_s) is not None else "")
            for name, sensor in self.session.sensors.items()
        ]

    def model_text(self) -> str | None:
        """Place and state of the model, unless it runs in the host."""
        acting = self.session.acting
        if acting is None or acting.engine.mode == "monolithic":
            return None
        stats = acting.engine
        state = f"answers in {stats.infer_ms:.0f} ms" if stats.alive else "IS GONE"
        return f"{state} ({stats.mode}, failures {stats.failures}, restarts {stats.restarts})"

    def commander_text(self) -> str:
        """Who commands the robot, if policy and operator take turns; otherwise empty."""
        return _COMMANDS[self.session.commander] if self.session.commander else ""

    def other_faults(self) -> list[str]:
        """The faults beside the emergency stop, the newest first."""
        return [fault for fault in reversed(self.session.faults) if fault != EMERGENCY_STOP]

    def line(self) -> str:
        """One line of status."""
        session, outcome = self.session, self.session.outcome
        commander = f", {text}" if (text := self.commander_text()) else ""
        pieces = [f"mode {session.mode}{commander}", f"loop {self.loop_text()}"]
        if session.acting is not None:
            stats = session.acting.dispatch
            pieces.append(f"plan {stats.plan_length}, latency {stats.latency_ms:.0f} ms")
        if (model := self.model_text()) is not None:
            pieces.append(f"model {model}")
        pieces += self.sensor_texts()
        pieces.append(f"episodes {outcome.episodes}, successes {outcome.successes}")
        pieces += [f"FAULT: {fault}" for fault in session.faults]
        if session.held:
            pieces.append(f"holding: {session.to_go_on()}")
        return " | ".join(pieces)


class RunTerminal(AbstractContextManager["RunTerminal"]):
    """A terminal whose keys a run reads, while the context is open, and which shows the run.

    Attributes:
        beat: called by the thread that reads keys, at least 20 times per second.
        gone: called by it when it ends because the terminal is gone.
    """

    beat: Callable[[], None]
    gone: Callable[[], None]

    @abstractmethod
    def subscribe(self) -> Any:
        """A new queue of the keys typed from now on (`queue.SimpleQueue[str]`)."""

    @abstractmethod
    def suspended(self) -> AbstractContextManager[None]:
        """Leave the terminal to other programs for a while, e.g. to the shell after Ctrl-Z."""

    @abstractmethod
    def close(self) -> None:
        """Stop reading, and restore the terminal. Safe to call twice."""

    @abstractmethod
    def display(self, runtime: Runtime, hooks: RunHooks, stack: ExitStack, *, err: bool) -> RunDisplay:
        """Show a run until the stack is closed, on standard output or, with `err`, on standard error."""


class Lines(RunDisplay):
    """Plain status lines, for output without a terminal."""

    def __init__(self, runtime: Runtime, hooks: RunHooks, *, err: bool) -> None:
        super().__init__(runtime.session)
        self._hooks = hooks
        self._err = err
        self._next_s = time.monotonic() + _PLAIN_PERIOD_S
        self.log = logging.StreamHandler(sys.stderr)
        self.log.setFormatter(LogFormatter("%(levelname).1s %(message)s"))

    @override
    def show(self) -> None:
        """Print a status line at intervals."""
        self.sample()
        if time.monotonic() >= self._next_s:
            self._next_s += _PLAIN_PERIOD_S
            echo(" | ".join(filter(None, (self.line(), self._hooks.line()))), err=self._err)
