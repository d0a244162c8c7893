"""Guides, questions and tables at the terminal."""

from __future__ import annotations

import queue
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import override

from ibrobot_terminal import Guide, KeyReader
from ibrobot_terminal.questions import confirm, prompt
from ibrobot_terminal.screen import Screen
from rich.box import SIMPLE_HEAD
from rich.live import Live
from rich.table import Table

from ibrobot_core.app import RequestError, echo

_PERIOD_S = 0.03
"""Time between two updates of a table [s]."""


def interactive() -> bool:
    """Whether there is a terminal to ask a user."""
    return sys.stdin.isatty()


def table(*columns: str) -> Table:
    """An empty table. Columns whose names begin with `>` are right-aligned."""
    made = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in columns:
        made.add_column(column.lstrip(">"), justify="right" if column.startswith(">") else "left", no_wrap=True)
    return made


class TerminalGuide(Guide):
    """The operator at a terminal. Warnings go to standard error."""

    @override
    def say(self, text: str, *, warning: bool = False) -> None:
        echo(text, err=warning)

    @override
    def show(self, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        Screen().print(_filled(columns, rows))

    @override
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        return confirm(question, flag=flag, default=default)

    @override
    def wait(
        self, request: str, *, flag: str = "", columns: Sequence[str] = (),
        rows: Callable[[], Sequence[Sequence[str]]] | None = None, sight: Callable[[], bytes | None] | None = None,
        seconds: float | None = None,
    ) -> None:  # fmt: skip
        if seconds is None and not interactive():
            done, instead = f"{request} " if rows is None else "", f", or give {flag}" if flag else ""
            raise RequestError(f"{done}There is no terminal to press Enter in; run the command in one{instead}")
        if rows is None:
            prompt(f"{request} Then press Enter ", flag=flag)
            return
        end = "Enter ends it" if seconds is None else f"for {seconds:g} s"
        echo(f"{request.removesuffix('.')} ({end}).")
        until = time.monotonic() + (seconds if seconds is not None else float("inf"))
        with ExitStack() as stack:
            typed = stack.enter_context(KeyReader()).subscribe() if interactive() else queue.SimpleQueue[str]()
            console = Screen()
            live = Live(console=console, auto_refresh=False)
            if console.is_terminal:
                stack.enter_context(live)
            while time.monotonic() < until:
                live.update(_filled(columns, rows()), refresh=console.is_terminal)
                try:
                    if typed.get(timeout=_PERIOD_S) == "enter":
                        break
                except queue.Empty:
                    continue
        if not console.is_terminal:
            console.print(_filled(columns, rows()))


def _filled(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    made = table(*columns)
    for row in rows:
        made.add_row(*row)
    return made
