"""The live status panel in the terminal, and the same facts as plain lines where there is no terminal."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from typing import override

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table

from ibrobot_core.launch.session import Session
from ibrobot_core.screen import text

_LOG_LINES = 6


class RecentLog(logging.Handler):
    """Keeps the last log lines for the panel."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: deque[RenderableType] = deque(maxlen=_LOG_LINES)

    @override
    def emit(self, record: logging.LogRecord) -> None:
        style = {logging.WARNING: "yellow", logging.ERROR: "bold red"}.get(record.levelno, "dim")
        self.lines.append(text(record.getMessage(), style, overflow="ellipsis", no_wrap=True))


def _loop_text(session: Session) -> str:
    loop = session.control.report["loop"]
    return (
        f"{loop['rate_hz']:.1f} Hz, late p50 {loop['lateness_p50_us']:.0f} us, "
        f"p99 {loop['lateness_p99_us']:.0f} us, missed {loop['missed']}"
    )


def _sensor_text(session: Session, name: str) -> str:
    age = f", {session.ages[name] * 1e3:.0f} ms old" if name in session.ages else ""
    return f"{name} {session.rates[name]:.1f} Hz{age}"


def _model_text(session: Session) -> str | None:
    """Where the model runs, unless it is in the host, and whether it answers."""
    stats = session.engine_stats
    if stats is None or stats.mode == "monolithic":
        return None
    state = f"answers in {stats.infer_ms:.0f} ms" if stats.alive else "IS GONE"
    return f"{state} ({stats.mode}, {stats.failures} failures, {stats.restarts} restarts)"


def plain_line(session: Session) -> str:
    """One line of status."""
    outcome, stats = session.outcome, session.stats
    pieces = [f"mode {session.mode}", f"loop {_loop_text(session)}"]
    if stats is not None:
        pieces.append(f"plan {stats.plan_length}, latency {stats.latency_ms:.0f} ms")
    if (model := _model_text(session)) is not None:
        pieces.append(f"model {model}")
    pieces += [_sensor_text(session, name) for name in session.rates]
    pieces.append(f"episodes {outcome.episodes}, successes {outcome.successes}")
    if outcome.faults:
        pieces.append(f"FAULTS {len(outcome.faults)}")
    return " | ".join(pieces)


def panel(session: Session, log: RecentLog, help_text: str, more: Sequence[tuple[str, str]] = ()) -> RenderableType:
    """The whole panel, with `more` rows of heading and text."""
    outcome, stats = session.outcome, session.stats
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold")
    facts.add_column()
    where = "simulation" if session.config.simulated else "hardware"
    modes = text("  ").join(
        text(f"F{i} ") + text(name, "reverse" if name == session.mode else "")
        for i, name in enumerate(session.config.control_modes, 1)
    )
    facts.add_row("mode", modes)
    facts.add_row("loop", _loop_text(session))
    if stats is not None:
        facts.add_row(
            "plan", f"{stats.plan_length} actions by {stats.strategy}, latency p50 {stats.latency_p50_ms:.0f}, "
            f"p99 {stats.latency_p99_ms:.0f} ms, holds {stats.holds}, failures {stats.failures}",
        )  # fmt: skip
    if (model := _model_text(session)) is not None:
        facts.add_row("model", model)
    if session.rates:
        facts.add_row("sensors", "  ".join(_sensor_text(session, name) for name in session.rates))
    facts.add_row("episodes", f"{outcome.episodes} done, {outcome.successes} successful")
    for heading, row in more:
        facts.add_row(heading, row)
    state = session.state
    estop = state is not None and state.estop
    faults = text("; ".join(outcome.faults[-3:]), "bold red") if outcome.faults else text("none", "green")
    facts.add_row("faults", faults)
    pieces: list[RenderableType] = [facts, text(""), _joints(session)]
    if help_text:
        pieces += [text(""), text(help_text, style="cyan")]
    pieces += [text(""), *log.lines]
    title = f"{session.config.robot.name} ({where})" + (" EMERGENCY STOP: F10 resets" if estop else "")
    return Panel(
        Group(*pieces),
        title=text(title),
        subtitle="Esc emergency stop   F10 reset   Ctrl-C stop",
        border_style="red" if estop else "blue",
    )


def _joints(session: Session) -> Table:
    table = Table.grid(padding=(0, 2))
    state, robot = session.state, session.config.robot
    if state is None:
        return table
    for i, joint in enumerate(robot.joints):
        done = float(np.clip((state.position[i] - joint.lower) / (joint.upper - joint.lower), 0.0, 1.0))
        bar = ProgressBar(total=1.0, completed=done, width=30)
        table.add_row(joint.name, bar, f"{state.position[i]:+.3f}", text(f"told {state.command[i]:+.3f} rad", "dim"))
    return table
