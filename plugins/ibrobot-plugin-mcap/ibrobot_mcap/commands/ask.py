"""Questions before something is deleted."""

from __future__ import annotations

import sys

import click


def confirmed(question: str) -> bool:
    """Ask a yes/no question.

    Raises:
        click.UsageError: if standard input has no answer.
    """
    try:
        return click.confirm(question)
    except click.Abort:
        if sys.stdin.isatty():
            raise
        message = f"{question} Standard input has no answer: run it in a terminal, or give --yes"
        raise click.UsageError(message) from None
