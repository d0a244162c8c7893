"""The live status panel, and plain status lines for output without a terminal."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, override

import numpy as np
from rich.console import ConsoleOptions, Group, RenderableType, RenderResult
from rich.progress_bar import ProgressBar
from rich.segment import Segment
from rich.table import Table

from ibrobot_core.control.core import EMERGENCY_STOP
from ibrobot_core.launch.session import Session
from ibrobot_core.screen import styled
from ibrobot_core.units import NS_PER_S

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

KEYS = {"Esc": "emergency stop", "F10": "reset", "Ctrl-C": "end"}
LOOP = ""
"""Name of the control loop, beside the names of sensors."""
_LOG_LINES = 6
_LINES_PER_LOG_LINE = 6
"""Height of the terminal for each line of messages [lines]."""
_RECENT_NS = 3 * NS_PER_S
"""Time over which rates are measured [ns]."""
_SAMPLE_NS = NS_PER_S // 4
_JOINT_WIDTH = 41
"""Width of a joint's name and numbers [columns]."""


_COMMANDS = {
    "policy": "the policy commands",
    "operator": "THE OPERATOR COMMANDS",
    "handover": "holding for the handover",
}


class RecentLog(logging.Handler):
    """Keeps the last log lines for the panel."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: deque[RenderableType] = deque(maxlen=_LOG_LINES)

    @override
    def emit(self, record: logging.LogRecord) -> None:
        style = {logging.WARNING: "yellow", logging.ERROR: "bold red"}.get(record.levelno, "dim")
        self.lines.append(styled(record.getMessage(), style))


class RecentRates:
    """Rates of the control loop and the sensors over the last seconds, from their counts."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, dict[str, int]]] = deque()

    def sample(self, session: Session) -> None:
        """Store the present counts; call it a few times per second."""
        now_ns = session.clock.now_ns()
        if self._samples and now_ns - self._samples[-1][0] < _SAMPLE_NS:
            return
        ticks = {LOOP: session.state.tick} if session.state is not None else {}
        self._samples.append((now_ns, {name: sensor.received for name, sensor in session.sensors.items()} | ticks))
        while len(self._samples) > 2 and now_ns - self._samples[1][0] >= _RECENT_NS:
            self._samples.popleft()

    def __getitem__(self, name: str) -> str:
        """The rate of a sensor, or of `LOOP`, as text; `- Hz` before the second sample."""
        if len(self._samples) < 2:
            return "- Hz"
        (first_ns, first), (last_ns, last) = self._samples[0], self._samples[-1]
        return f"{(last.get(name, 0) - first.get(name, 0)) * NS_PER_S / (last_ns - first_ns):.1f} Hz"


def _loop_text(session: Session, rates: RecentRates) -> str:
    loop = session.control.report["loop"]
    return (
        f"{rates[LOOP]}, late p50 {loop['lateness_p50_us']:.0f} us, "
        f"p99 {loop['lateness_p99_us']:.0f} us, missed {loop['missed']}"
    )


def _sensor_texts(session: Session, rates: RecentRates) -> list[str]:
    return [
        f"{name} {rates[name]}" + (f", {age_s * 1e3:.0f} ms old" if (age_s := sensor.age_s) is not None else "")
        for name, sensor in session.sensors.items()
    ]


def _model_text(session: Session) -> str | None:
    """Place and state of the model, unless it runs in the host."""
    if session.acting is None or session.acting.engine.mode == "monolithic":
        return None
    stats = session.acting.engine
    state = f"answers in {stats.infer_ms:.0f} ms" if stats.alive else "IS GONE"
    return f"{state} ({stats.mode}, {stats.failures} failures, {stats.restarts} restarts)"


def plain_line(session: Session, rates: RecentRates) -> str:
    """One line of status."""
    outcome = session.outcome
    commander = f", {_COMMANDS[session.commander]}" if session.commander else ""
    pieces = [f"mode {session.mode}{commander}", f"loop {_loop_text(session, rates)}"]
    if session.acting is not None:
        stats = session.acting.dispatch
        pieces.append(f"plan {stats.plan_length}, latency {stats.latency_ms:.0f} ms")
    if (model := _model_text(session)) is not None:
        pieces.append(f"model {model}")
    pieces += _sensor_texts(session, rates)
    pieces.append(f"episodes {outcome.episodes}, successes {outcome.successes}")
    pieces += [f"FAULT: {fault}" for fault in session.faults]
    if session.held:
        pieces.append(f"holding: {session.to_go_on()}")
    return " | ".join(pieces)


def panel(
    session: Session, log: RecentLog, rates: RecentRates, help_text: str, more: Sequence[tuple[str, str]] = ()
) -> RenderableType:
    """The panel, with `more` rows of heading and text, and help on keys; a small terminal cuts off its end."""
    where = "in simulation" if session.config.simulated else "on hardware"
    modes = styled(f"{session.config.robot.name} {where}  ", "bold") + styled("  ").join(
        styled(f"{key} ")
        + styled(
            name, "reverse" if name == session.mode else "dim strike" if name in session.config.unavailable else ""
        )
        for key, name in session.mode_keys.items()
    )
    # A device moves nothing while the robot holds.
    source = "" if session.faults or session.held else session.command_source.help()
    return Group(  # `Live` cuts off what does not fit
        styled(" ").join(styled(key, "bold reverse") + styled(f" {does}", "bold") for key, does in KEYS.items()),
        *_faults(session),
        *_rows(more),
        _Newest(tuple(log.lines)),  # other threads log while it is drawn
        modes,
        *(styled(each, "cyan") for each in (source, help_text) if each),
        *_rows(_facts(session, rates)),
        _Joints(session),
    )


def _rows(rows: Iterable[tuple[str, str]]) -> list[Text]:
    return [styled(f"{heading:<10}", "bold") + styled(row) for heading, row in rows]


def _faults(session: Session) -> list[Text]:
    """The reasons why the robot holds, in full, the newest fault first."""
    if session.held and not session.faults:
        return [styled(f"holding after the reset: {session.to_go_on()}", "bold yellow")]
    estop = session.state is not None and session.state.estop
    others = [fault for fault in reversed(session.faults) if fault != EMERGENCY_STOP]
    return [
        *([styled("EMERGENCY STOP: F10 resets it", "bold reverse red")] if estop else []),
        *(styled(f"FAULT: {fault}; F10 resets it", "bold red") for fault in others),
    ]


def _facts(session: Session, rates: RecentRates) -> Iterator[tuple[str, str]]:
    """Rows of heading and text, the most important first."""
    outcome = session.outcome
    if session.commander:
        yield "robot", _COMMANDS[session.commander]
    if session.sensors:
        yield "sensors", "  ".join(_sensor_texts(session, rates))
    if session.acting is not None:
        stats = session.acting.dispatch
        yield (
            "plan",
            f"{stats.plan_length} actions by {stats.strategy}, latency p50 {stats.latency_p50_ms:.0f}, p99 "
            f"{stats.latency_p99_ms:.0f} ms, holds {stats.holds}, "
            f"unreachable {stats.unreachable}, failures {stats.failures}",
        )
    if (model := _model_text(session)) is not None:
        yield "model", model
    yield "loop", _loop_text(session, rates)
    yield "episodes", f"{outcome.episodes} done, {outcome.successes} successful"
    yield "faults", f"{len(session.faults)} now, {len(outcome.faults)} in this run"


class _Newest:
    """The newest messages in full: as many as fit into a part of the screen and `_LOG_LINES`, and at least one."""

    def __init__(self, messages: Sequence[RenderableType]) -> None:
        self._messages = messages

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        most = min(_LOG_LINES, console.height // _LINES_PER_LOG_LINE)
        shown: list[list[Segment]] = []
        for message in reversed(self._messages):
            lines = console.render_lines(message, options.update(height=None), pad=False)
            if shown and len(shown) + len(lines) > most:
                break
            shown = lines + shown
        for line in shown:
            yield from line
            yield Segment.line()


class _Joints:
    """Position and command of each joint; in wide terminals, also a bar between the limits."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        state, robot = self._session.state, self._session.config.robot
        if state is None:
            return
        yield styled("joints [rad, or m where they slide]", "dim")
        table = Table.grid(padding=(0, 1))
        for i, joint in enumerate(robot.joints):
            done = float(np.clip((state.position[i] - joint.lower) / (joint.upper - joint.lower), 0.0, 1.0))
            room = max(0, options.max_width - _JOINT_WIDTH)
            bar = [ProgressBar(total=1.0, completed=done, width=min(room, 30))] if room else []
            target = styled(f"target {state.command[i]:+.2f}", "dim")
            table.add_row(joint.name, f"{state.position[i]:+.2f}", target, *bar)
        yield table
