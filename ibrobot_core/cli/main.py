"""The command `ibrobot`: finds its subcommands without importing them, and turns errors into exit codes."""

from __future__ import annotations

import errno
import io
import os
import re
import sys
from difflib import get_close_matches
from typing import Any, override

import click
from click.shell_completion import shell_complete

from ibrobot_core import __version__
from ibrobot_core.bug_reports import DEBUG, describe_bug
from ibrobot_core.cli.command import let_interrupts_raise
from ibrobot_core.descriptors import Command
from ibrobot_core.errors import IbrobotError
from ibrobot_core.plugins import CORE, installed_plugins
from ibrobot_core.safe_output import echo

_FAILED, _WRONG, _INTERRUPTED = 1, 2, 130
"""Exit codes of errors without their own; docs/reference/exit-codes.md lists all."""

_COMPLETE = "_IBROBOT_COMPLETE"
"""With this variable, a shell asks how to complete a command line."""
_OUTPUT_REFUSED = (errno.ENOSPC, errno.EPIPE, errno.EIO)
"""Errors of a full device, a reader that is gone, and a terminal that is gone."""


def _click_command(command: Command) -> click.Command:
    from ibrobot_core.cli.declared import click_command  # not for the help of `ibrobot`, which would import numpy

    return click_command(command)


class Commands(click.Group):
    """The commands whose names begin with the same words; each is imported when it is called.

    A command may have others below it, as `plugins` of ibrobot-terminal has `plugins show`: the first argument decides.
    """

    def __init__(self, words: str = "", **settings: Any) -> None:
        self._prefix = f"{words} " if words else ""
        if words and (command := installed_plugins().commands.get(words)) is not None:  # the top is made at import
            settings = {"help": f"{command.summary}\n\n{command.about}"}
            if command.does is not None:
                own = _click_command(command)
                settings = {"help": own.help, "params": own.params, "callback": own.callback}
        settings.setdefault("name", words.rpartition(" ")[2])
        super().__init__(invoke_without_command=bool(words) and "callback" in settings, **settings)
        self.allow_interspersed_args = self.invoke_without_command

    @override
    def list_commands(self, ctx: click.Context | None) -> list[str]:
        # The next words of the names, sorted; at the top those of core come first.
        packages = {n: p for n, p in installed_plugins().command_packages.items() if n.startswith(self._prefix)}
        words = {name: name.removeprefix(self._prefix).partition(" ")[0] for name in packages}
        own = [words[name] for name, package in packages.items() if package == CORE and not self._prefix]
        return list(dict.fromkeys([*own, *sorted(words.values())]))

    @override
    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        registry, name = installed_plugins(), f"{self._prefix}{cmd_name}"
        if name in registry.commands and registry.command_packages[name] != CORE:
            let_interrupts_raise()  # a run of core handles signals itself
        if any(each.startswith(f"{name} ") for each in registry.commands):
            return Commands(name)
        if name not in registry.commands:
            above = self._prefix.strip()  # may be a command that is not installed, unless the word below is mistyped
            for each in (name, "" if get_close_matches(cmd_name, self.list_commands(ctx)) else above):
                if each in registry.official("command") and each not in registry.commands:
                    raise registry.not_found("command", each)
            return None
        return _click_command(registry.command(name))

    @override
    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        named = args[0] if args and args[0] in self.list_commands(None) else ""
        command = self.get_command(click.Context(self), named) if named and self.invoke_without_command else None
        if command is None:
            return super().make_context(info_name, args, parent, **extra)
        return command.make_context(f"{info_name} {named}", args[1:], parent, **extra)

    @override
    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        commands = installed_plugins().commands
        known = ((name, commands.get(f"{self._prefix}{name}")) for name in self.list_commands(ctx))
        with formatter.section("Commands"):
            formatter.write_dl([(name, each.summary) for name, each in known if each is not None and not each.hidden])


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ibrobot")
@click.option("--debug", is_flag=True, help="Print the traceback of a bug.")
def cli(debug: bool) -> None:
    """Embodied-AI robots from one YAML: teleoperation, recording, policies, planning and control."""
    if debug:
        os.environ[DEBUG] = "1"


def main() -> None:
    """Run the command line. Every error is one line and sets the exit code; see docs/reference/exit-codes.md."""
    _replace_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ASCII terminal shows \u2026 instead of raising an error
            stream.reconfigure(errors="backslashreplace")
    code = 0
    try:
        try:  # not `cli()`, which would exit without a word if the reader of the output is gone
            if asked := os.environ.get(_COMPLETE):
                sys.exit(shell_complete(cli, {}, "ibrobot", _COMPLETE, asked))
            with cli.make_context("ibrobot", sys.argv[1:]) as context:
                cli.invoke(context)
        finally:
            sys.stdout.flush()
    except click.exceptions.Exit as end:
        code = end.exit_code
    except click.exceptions.NoArgsIsHelpError as error:  # a group without a command
        echo(error.format_message(), err=True)
        code = _WRONG
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - the end of the process: nothing else can tell it
        lines, code = _error_texts(error)
        for line in lines:
            echo(f"error: {line}", err=True)
    sys.exit(code)


def _replace_closed_streams() -> None:
    """Open the null device in place of standard streams that the caller has closed."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            if descriptor != number:
                os.dup2(descriptor, number)
                os.close(descriptor)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115


def _suggestion(message: str, ctx: click.Context | None) -> str:
    """The command that a mistyped one resembles."""
    mistyped = re.fullmatch(r"No such command '(.*)'", message)
    if mistyped is None or ctx is None or not isinstance(ctx.command, click.Group):
        return ""
    close = get_close_matches(mistyped[1], ctx.command.list_commands(ctx), 1)
    return f", did you mean {close[0]!r}?" if close else ""


def _error_texts(error: BaseException) -> tuple[list[str], int]:
    """The message lines of an error, and the exit code."""
    if isinstance(error, IbrobotError):
        return str(error).splitlines(), error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return ["stopped"], _INTERRUPTED
    if isinstance(error, click.UsageError):
        hint = f"; see `{error.ctx.command_path} --help`" if error.ctx is not None else ""
        message = error.format_message().replace("\n", " ").removesuffix(".")
        return [f"{message}{_suggestion(message, error.ctx)}{hint}"], _WRONG
    if isinstance(error, OSError) and (system_error := _system_error(error)) is not None:
        return system_error
    return [describe_bug(error)], _FAILED


def _system_error(error: OSError) -> tuple[list[str], int] | None:
    """The message and exit code of an error of the caller's files, output or folder; None for any other."""
    if error.strerror and str(error.filename) in sys.argv:
        return [f"{error.filename}: {error.strerror}"], _WRONG
    if error.filename is None and error.errno in _OUTPUT_REFUSED:
        from ibrobot_core.output_thread import discard

        discard([1])  # so that the interpreter does not try to write it once more
        return [f"standard output: {error.strerror}"], _FAILED
    if isinstance(error, FileNotFoundError):
        try:
            os.getcwd()
        except FileNotFoundError:
            return ["the working folder no longer exists: change to another one"], _WRONG
    return None
