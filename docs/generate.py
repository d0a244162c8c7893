"""The pages that come from the code and from the packages: robot YAML, options, plugins, command line, READMEs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import click
from api_page import api_page, api_parts
from option_pages import config_page, jobs_page, options_of_kinds, options_page, services_page
from plugin_index import plugin_page
from site_pages import SPLIT, sections_apart

from ibrobot_core.cli.main import cli

_LINK = re.compile(r"\[([^\]]+)\]\(([^)#\s]+)(#[\w-]+)?\)")


def command_lines(command: click.Command, path: str) -> Iterator[str]:
    """Lines on a command and those below it."""
    context = click.Context(command, info_name=path, max_content_width=110)
    yield f"## `{path}`\n"
    yield "```text"
    yield command.get_help(context)
    yield "```\n"
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            yield from command_lines(found, f"{path} {name}")


def _commands() -> dict[str, click.Command]:
    context = click.Context(cli)
    found = {name: cli.get_command(context, name) for name in cli.list_commands(context)}
    return {name: command for name, command in found.items() if command is not None}


def cli_page() -> Iterator[str]:
    """Lines of the page on the command line, which has a page for each command."""
    yield "# Command line\n"
    yield "`ibrobot COMMAND --help` prints what the page of the command has.\n"
    yield "| command | |"
    yield "|---|---|"
    for name, command in _commands().items():
        yield f"| [`ibrobot {name}`](cli/{name}.md) | {command.get_short_help_str(200)} |"
    yield "\n```{toctree}\n:hidden:\n"
    yield from (f"cli/{name}" for name in _commands())
    yield "```\n"


def _cli_parts() -> dict[str, str]:
    """Command -> the text of its page."""
    parts = {}
    for name, command in _commands().items():
        _, *lines = command_lines(command, f"ibrobot {name}")
        parts[name] = "\n".join([f"# `ibrobot {name}`\n", *lines])
    return parts


PAGES = {
    "reference/config": config_page,
    "reference/options": options_page,
    "reference/plugins": plugin_page,
    "reference/cli": cli_page,
    "reference/api": api_page,
    "reference/jobs": jobs_page,
    "reference/services": services_page,
}
"""The pages that come from the code, in place of short ones for readers of the repository."""


def write(docs: Path) -> None:
    """Write the pages that only the site has: the parts of long reference pages, and the READMEs of the packages."""
    reference = docs / "reference"
    _write(reference / "options", {kind: "\n".join(page) for kind, page in options_of_kinds().items()})
    _write(reference / "cli", _cli_parts())
    _write(reference / "api", {name: "\n".join(page) for name, page in api_parts().items()})
    for page in SPLIT:
        name = page.removeprefix("reference/")
        _, parts = sections_apart(name, (reference / f"{name}.md").read_text(encoding="utf-8"))
        _write(reference / name, parts)
    _write(docs / "plugins", readme_pages(docs.parent))


def _write(folder: Path, pages: dict[str, str]) -> None:
    """Write pages into a folder of their own; one that is the same is left alone, and others are removed."""
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.md"):
        if path.stem not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text() != f"{text}\n":
            path.write_text(f"{text}\n")


def readme_pages(root: Path) -> dict[str, str]:
    """Package -> the text of its README, with links that are right in `docs/plugins`; and an index."""
    pages = {}
    for readme in sorted(root.glob("plugins/*/README.md")):
        text = readme.read_text(encoding="utf-8")
        pages[readme.parent.name] = _LINK.sub(lambda match, at=readme: _moved(match, at, root), text)  # type: ignore[misc]
    lines = ["# Packages", "", "What each package of the repository does, from its README.", ""]
    lines += [f"- [{name}]({name}.md)" for name in pages]
    return {**pages, "index": "\n".join(lines)}


def _moved(match: re.Match[str], readme: Path, root: Path) -> str:
    """A link of a README, as a page in `docs/plugins` has it; one to a file that is no page becomes plain text."""
    text, target, anchor = match[1], match[2], match[3] or ""
    if ":" in target:
        return match[0]
    path = (readme.parent / target).resolve()
    if path.name == "README.md" and path.parent.parent == root / "plugins":
        return f"[{text}]({path.parent.name}.md{anchor})"
    if path.is_relative_to(root / "docs") and path.suffix in (".md", ".webp"):
        return f"[{text}](../{path.relative_to(root / 'docs')}{anchor})"
    return text
