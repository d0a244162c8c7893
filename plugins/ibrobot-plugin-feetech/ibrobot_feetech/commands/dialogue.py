"""Questions to the person at the terminal, and tables."""

from __future__ import annotations

import sys

import click
from rich.box import SIMPLE_HEAD
from rich.table import Table

from ibrobot_core.api import IbrobotError, Screen


class Unanswered(IbrobotError):
    """A question that nobody can answer, e.g. in a script without the flag that answers it."""

    exit_code = 2


def interactive() -> bool:
    """Whether a person can answer."""
    return sys.stdin.isatty()


def agree(question: str, *, flag: str, default: bool = False) -> bool:
    """Ask for yes or no.

    Args:
        question: e.g. `Overwrite it?`.
        flag: the option that answers it, for whoever has no terminal.
        default: what Enter means.

    Raises:
        Unanswered: where there is no terminal.
    """
    if not interactive():
        raise Unanswered(f"{question} Nobody is at a terminal to answer; run it in one, or give {flag}")
    return click.confirm(question, default=default)


def wait_for_enter(request: str, *, flag: str) -> None:
    """Ask to do something and to press Enter.

    Raises:
        Unanswered: where there is no terminal.
    """
    if not interactive():
        raise Unanswered(f"{request} Nobody is at a terminal to press Enter; run it in one, or give {flag}")
    click.prompt(f"{request} Then press Enter", default="", show_default=False, prompt_suffix=" ")


def table(*columns: str) -> Table:
    """An empty table. A column whose name begins with `>` is set to the right."""
    made = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in columns:
        made.add_column(column.lstrip(">"), justify="right" if column.startswith(">") else "left", no_wrap=True)
    return made


def show(made: Table) -> None:
    """Print a table: in colour in a terminal, as plain text elsewhere."""
    Screen().print(made)
