"""The command `ibrobot`: finds its subcommands without importing them, and turns errors into exit codes."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import override

import click

from ibrobot_core import __version__
from ibrobot_core.outside import echo

COMMANDS = {
    "launch": ("ibrobot_core.cli.launch:launch", "Run a robot, real or simulated."),
    "record": ("ibrobot_core.cli.record:record", "Run a robot and record its episodes."),
    "replay": ("ibrobot_core.cli.replay:replay", "Play a recorded episode on a robot, and compare."),
    "convert": ("ibrobot_core.cli.convert:convert", "Make a dataset for training from episodes."),
    "serve": ("ibrobot_core.cli.serve:serve", "Run a model for robots elsewhere."),
    "config": ("ibrobot_core.cli.config:config", "Check and show robot YAMLs."),
    "plugins": ("ibrobot_core.cli.plugins:plugins", "List what the installed plugins offer."),
    "doctor": ("ibrobot_core.cli.doctor:doctor", "Check this machine, with the remedy for what it lacks."),
}
"""Name -> where the click command is, and its one line in the help."""


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called; those of plugins come after core's own."""

    @override
    def list_commands(self, ctx: click.Context) -> list[str]:
        from ibrobot_core.plugins import installed

        return [*COMMANDS, *sorted(set(installed().commands) - set(COMMANDS))]

    @override
    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in COMMANDS:
            module, _, attribute = COMMANDS[cmd_name][0].partition(":")
            command: click.Command = getattr(import_module(module), attribute)
            return command
        from ibrobot_core.plugins import installed

        contributed = installed().commands.get(cmd_name)
        return contributed.load() if contributed is not None else None

    @override
    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from ibrobot_core.plugins import installed

        contributed = installed().commands
        summaries = {name: command.summary for name, command in sorted(contributed.items())}
        summaries |= {name: summary for name, (_, summary) in COMMANDS.items()}
        with formatter.section("Commands"):
            formatter.write_dl([(name, summaries[name]) for name in self.list_commands(ctx)])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ibrobot")
def cli() -> None:
    """Embodied-AI robots from one YAML: teleoperation, recording, policies, planning and control."""


def main() -> None:
    """Run the command line. Errors that a user may see are told in one line each and set the exit code."""
    from ibrobot_core.errors import IbrobotError
    from ibrobot_core.outside import show_traceback

    sys.excepthook = show_traceback

    try:
        cli(prog_name="ibrobot")
    except IbrobotError as error:
        for line in str(error).splitlines():
            echo(f"error: {line}", err=True)
        sys.exit(error.exit_code)
