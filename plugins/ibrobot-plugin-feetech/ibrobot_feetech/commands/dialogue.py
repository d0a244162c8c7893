"""Questions at the terminal, and tables."""

from __future__ import annotations

import sys

import click
from rich.box import SIMPLE_HEAD
from rich.table import Table

from ibrobot_core.api import IbrobotError, Screen


class Unanswered(IbrobotError):
    """A question without a terminal, e.g. in a script that lacks the flag that answers it."""

    exit_code = 2


def interactive() -> bool:
    """Whether there is a terminal to ask a user."""
    return sys.stdin.isatty()


def agree(question: str, *, flag: str, default: bool = False) -> bool:
    """Ask a yes/no question.

    Args:
        question: e.g. `Overwrite it?`.
        flag: the option that answers it without a terminal.
        default: the answer if the user only presses Enter.

    Raises:
        Unanswered: if there is no terminal.
    """
    if not interactive():
        raise Unanswered(f"{question} There is no terminal to ask; run the command in one, or give {flag}")
    return click.confirm(question, default=default)


def wait_for_enter(request: str, *, flag: str) -> None:
    """Ask the user to do something and press Enter.

    Raises:
        Unanswered: if there is no terminal.
    """
    if not interactive():
        raise Unanswered(f"{request} There is no terminal to press Enter in; run the command in one, or give {flag}")
    click.prompt(f"{request} Then press Enter", default="", show_default=False, prompt_suffix=" ")


def table(*columns: str) -> Table:
    """An empty table. Columns whose names begin with `>` are right-aligned."""
    made = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in columns:
        made.add_column(column.lstrip(">"), justify="right" if column.startswith(">") else "left", no_wrap=True)
    return made


def show(made: Table) -> None:
    """Print a table, in colour if the output is a terminal."""
    Screen().print(made)
