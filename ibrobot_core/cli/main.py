"""The command `ibrobot`: finds its subcommands without importing them, and turns errors into exit codes."""

from __future__ import annotations

import io
import os
import sys
from importlib import import_module
from typing import override

import click

from ibrobot_core import __version__
from ibrobot_core.bugs import DEBUG, describe_bug
from ibrobot_core.cli.command import let_interrupts_raise
from ibrobot_core.errors import IbrobotError
from ibrobot_core.outside import echo

_FAILED, _WRONG, _INTERRUPTED = 1, 2, 130
"""Exit codes of errors without their own; docs/reference/exit-codes.md lists all."""

COMMANDS = {
    "launch": ("ibrobot_core.cli.launch:launch", "Run a robot, real or simulated."),
    "config": ("ibrobot_core.cli.config:config", "Check and show robot YAMLs."),
    "plugins": ("ibrobot_core.cli.plugins:plugins", "List what the installed plugins offer."),
    "doctor": ("ibrobot_core.cli.doctor:doctor", "Check this machine, and print a remedy for each fault."),
}
"""Name -> place of the click command, and its line in the help."""


class LazyGroup(click.Group):
    """A group that imports commands when they are called; commands of plugins are listed after those of core."""

    @override
    def list_commands(self, ctx: click.Context) -> list[str]:
        from ibrobot_core.plugins import installed_plugins

        return [*COMMANDS, *sorted(set(installed_plugins().commands) - set(COMMANDS))]

    @override
    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in COMMANDS:
            module, _, attribute = COMMANDS[cmd_name][0].partition(":")
            command: click.Command = getattr(import_module(module), attribute)
            return command
        from ibrobot_core.plugins import installed_plugins, official_plugins

        contributed = installed_plugins().commands.get(cmd_name)
        if contributed is None:
            if any(cmd_name in offers.get("command", ()) for offers in official_plugins().values()):
                raise installed_plugins().not_found("command", cmd_name)
            return None
        command = contributed.load()
        let_interrupts_raise()
        return command

    @override
    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from ibrobot_core.plugins import installed_plugins

        contributed = installed_plugins().commands
        summaries = {name: command.summary for name, command in sorted(contributed.items())}
        summaries |= {name: summary for name, (_, summary) in COMMANDS.items()}
        with formatter.section("Commands"):
            formatter.write_dl([(name, summaries[name]) for name in self.list_commands(ctx)])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ibrobot")
@click.option("--debug", is_flag=True, help="Print the traceback of a bug.")
def cli(debug: bool) -> None:
    """Embodied-AI robots from one YAML: teleoperation, recording, policies, planning and control."""
    if debug:
        os.environ[DEBUG] = "1"


def main() -> None:
    """Run the command line. Every error is one line and sets the exit code; see docs/reference/exit-codes.md."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ASCII terminal shows \u2026 instead of raising an error
            stream.reconfigure(errors="backslashreplace")
    try:
        sys.exit(cli(prog_name="ibrobot", standalone_mode=False))
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the end of the process: nothing else can tell it
        lines, code = _error_lines(error)
        for line in lines:
            echo(f"error: {line}", err=True)
        sys.exit(code)


def _error_lines(error: BaseException) -> tuple[list[str], int]:
    """The message lines of an error, and the exit code."""
    if isinstance(error, IbrobotError):
        return str(error).splitlines(), error.exit_code
    if isinstance(error, click.Abort | KeyboardInterrupt):
        return ["stopped"], _INTERRUPTED
    if isinstance(error, click.UsageError):
        hint = f"; see {error.ctx.command_path} --help" if error.ctx is not None else ""
        return [error.format_message().replace("\n", " ").removesuffix(".") + hint], _WRONG
    if isinstance(error, click.ClickException):
        return error.format_message().splitlines(), _WRONG if isinstance(error, click.FileError) else error.exit_code
    if isinstance(error, OSError) and error.strerror and str(error.filename) in sys.argv:
        return [f"{error.filename}: {error.strerror}"], _WRONG
    return [describe_bug(error)], _FAILED
