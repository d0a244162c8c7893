"""Prints what a command has done: as an event for a program, or as a line."""

from __future__ import annotations

from ibrobot_core.app import Command, echo, emit
from ibrobot_mcap.changes import Changed


def report(command: Command, change: Changed, *, events: bool) -> None:
    """Print a change."""
    if events:
        emit(command, change)
    else:
        echo(change.shown().text)
