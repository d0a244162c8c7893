"""Writes the reference pages that come from the code: the robot YAML, options, plugins and the command line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
from api_page import api_page
from option_pages import config_page, jobs_page, options_page, services_page
from plugin_index import plugin_page

from ibrobot_core.cli.main import cli


def command_lines(command: click.Command, path: str) -> Iterator[str]:
    """Lines on a command and those below it."""
    context = click.Context(command, info_name=path, max_content_width=110)
    yield f"## `{path}`\n"
    yield "```text"
    yield command.get_help(context)
    yield "```\n"
    if isinstance(command, click.Group) and command is not cli:
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from command_lines(found, f"{path} {name}")


def cli_page() -> Iterator[str]:
    """Lines of the page on the command line."""
    yield "# Command line\n"
    yield from command_lines(cli, "ibrobot")
    context = click.Context(cli)
    for name in cli.list_commands(context):
        found = cli.get_command(context, name)
        assert found is not None
        yield from command_lines(found, f"ibrobot {name}")


def write(directory: Path) -> None:
    """Write all generated pages into `directory`; a page that is the same is left alone."""
    pages = {
        "config.md": config_page,
        "options.md": options_page,
        "plugins.md": plugin_page,
        "cli.md": cli_page,
        "api.md": api_page,
        "jobs.md": jobs_page,
        "services.md": services_page,
    }
    for name, page in pages.items():
        text = "\n".join(page()) + "\n"
        path = directory / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
