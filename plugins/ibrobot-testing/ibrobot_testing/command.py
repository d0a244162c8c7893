"""The command `ibrobot`, for tests that run it in a separate process, or a command of it by `CliRunner`."""

from __future__ import annotations

import sys

import click

from ibrobot_core.app import Command


def ibrobot_command(before: str = "") -> tuple[str, ...]:
    """The beginning of a command line that runs `ibrobot` with this interpreter; append its arguments.

    Args:
        before: Python source that the process runs first.
    """
    return sys.executable, "-c", f"{before}\nfrom ibrobot_core.cli.main import main\nmain()\n"


def command_line(command: str | Command) -> click.Command:
    """The command line of a command; of a name also that of the commands whose names begin with it."""
    from ibrobot_core.cli.declared import click_command
    from ibrobot_core.cli.main import cli

    if isinstance(command, Command):
        return click_command(command)
    current: click.Command | None = cli
    for word in command.split():
        assert isinstance(current, click.Group), command
        current = current.get_command(click.Context(current), word)
    assert current is not None, command
    return current
