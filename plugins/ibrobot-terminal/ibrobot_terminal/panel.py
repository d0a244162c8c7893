"""The live status panel."""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, override

import numpy as np
from rich.console import ConsoleOptions, Group, RenderableType, RenderResult
from rich.progress_bar import ProgressBar
from rich.segment import Segment
from rich.table import Table

from ibrobot_core.api import String
from ibrobot_terminal.plural import counted
from ibrobot_terminal.screen import styled

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from ibrobot_core.app import RunDisplay, RunView

KEYS = {"Esc": "emergency stop", "F10": "reset", "Ctrl-C": "end"}
_LOG_LINES = 6
_LINES_PER_LOG_LINE = 6
"""Height of the terminal for each line of messages [lines]."""
_JOINT_WIDTH = 43
"""Width of a joint's name and numbers [columns]."""
_SHORT = 1.0
"""Range of joints whose positions have a third digit [rad or m]."""


class RecentLog(logging.Handler):
    """Keeps the last messages for the panel; all lines but the first are indented, so that none looks like a row."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: deque[RenderableType] = deque(maxlen=_LOG_LINES)

    @override
    def emit(self, record: logging.LogRecord) -> None:
        style = {logging.WARNING: "yellow", logging.ERROR: "bold red"}.get(record.levelno, "dim")
        self.lines.append(styled(record.getMessage().replace("\n", "\n  "), style))


def panel(
    display: RunDisplay, log: RecentLog, help_text: str, more: Sequence[tuple[str, str]] = ()
) -> RenderableType:  # fmt: skip
    """The panel, with `more` rows of heading and text, and help on keys; a small terminal cuts off its end."""
    session = display.session
    where = "in simulation" if session.config.simulated else "on hardware"
    modes = styled(f"{session.config.robot.name} {where}  ", "bold") + styled("  ").join(
        styled(f"{key} ")
        + styled(
            name, "reverse" if name == session.mode else "dim strike" if name in session.config.unavailable else ""
        )
        for key, name in session.mode_keys.items()
    )
    apart = kept_apart(session)
    # A device moves nothing while the robot holds.
    source = "" if session.faults or session.held else session.command_source.help()
    return Group(  # `Live` cuts off what does not fit
        styled(" ").join(styled(key, "bold reverse") + styled(f" {does}", "bold") for key, does in KEYS.items()),
        *_faults(display),
        *([styled(f"the guard holds the arm back: {apart['text']}", "yellow")] if apart else ()),
        *_rows(more),
        _Newest(tuple(log.lines)),  # other threads log while it is drawn
        modes,
        *(styled(each, "cyan") for each in (source, help_text) if each),
        *_rows(_facts(display)),
        Joints(display),
    )


def kept_apart(session: RunView) -> dict[str, Any]:
    """What the guard of control keeps apart now, by the newest message on `/guard`; empty if it lets commands pass."""
    newest = session.bus.latched().get("/guard")
    label = newest.message.data if newest is not None and isinstance(newest.message, String) else ""
    try:
        read = json.loads(label or "{}")
        return {"text": str(read["text"]), "sound": bool(read.get("sound"))} if read else {}
    except (LookupError, TypeError, ValueError, AttributeError):
        return {"text": label, "sound": False}


class GuardBell:
    """Rings when the guard begins to hold the arm back, and for each other thing, if its option `sound` asks for it."""

    def __init__(self, console: Console) -> None:
        self._console, self._heard = console, ""

    def hear(self, apart: Mapping[str, Any]) -> None:
        """Take in what the guard keeps apart, as of `kept_apart`."""
        text = apart.get("text", "")
        if apart.get("sound") and text != self._heard:
            self._console.bell()
        self._heard = text


def _rows(rows: Iterable[tuple[str, str]]) -> list[Text]:
    return [styled(f"{heading:<10}", "bold") + styled(row) for heading, row in rows]


def _faults(display: RunDisplay) -> list[Text]:
    """The reasons why the robot holds, in full, the newest fault first."""
    session = display.session
    if session.held and not session.faults:
        return [styled(f"holding: {session.to_go_on()}", "bold yellow")]
    estop = session.state is not None and session.state.estop
    return [
        *([styled("EMERGENCY STOP: F10 resets it", "bold reverse red")] if estop else []),
        *(styled(f"FAULT: {fault}; F10 resets it", "bold red") for fault in display.other_faults()),
    ]


def _facts(display: RunDisplay) -> Iterator[tuple[str, str]]:
    """Rows of heading and text, the most important first."""
    session, outcome = display.session, display.session.outcome
    if commander := display.commander_text():
        yield "robot", commander
    if session.sensors:
        yield "sensors", "  ".join(display.sensor_texts())
    if session.acting is not None:
        stats = session.acting.dispatch
        yield (
            "plan",
            f"{counted(stats.plan_length, 'action')} by {stats.strategy}, latency p50 {stats.latency_p50_ms:.0f}, p99 "
            f"{stats.latency_p99_ms:.0f} ms, holds {stats.holds}, "
            f"unreachable {stats.unreachable}, failures {stats.failures}",
        )
    if (model := display.model_text()) is not None:
        yield "model", model
    yield "loop", display.loop_text()
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


class Joints:
    """Position and command of each joint, as on the page of a run; in wide terminals, also a bar between the limits."""

    def __init__(self, display: RunDisplay) -> None:
        self._display = display

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        state, robot = self._display.session.state, self._display.session.config.robot
        if state is None:
            return
        yield styled("joints [rad, or m where they slide]", "dim")
        table = Table.grid(padding=(0, 1))
        for i, joint in enumerate(robot.joints):
            done = float(np.clip((state.position[i] - joint.lower) / (joint.upper - joint.lower), 0.0, 1.0))
            room = max(0, options.max_width - _JOINT_WIDTH)
            bar = [ProgressBar(total=1.0, completed=done, width=min(room, 30))] if room else []
            digits = 3 if joint.upper - joint.lower < _SHORT else 2
            position, command = (
                f"{round(float(each[i]), digits) + 0.0:+.{digits}f}" for each in (state.position, state.command)
            )
            table.add_row(joint.name, position, styled(f"target {command}", "dim"), *bar)
        yield table
