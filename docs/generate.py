"""Writes the reference pages that come from the code: the robot YAML's sections and the command line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import attrs
import click
from plugin_index import plugin_page

from ibrobot_core.cli.main import cli
from ibrobot_core.config import schema
from ibrobot_core.robot import Description, Joint, Robot

SECTIONS: tuple[tuple[str, type], ...] = (
    ("robot", Robot),
    ("robot.joints[]", Joint),
    ("robot.description", Description),
    ("contract", schema.ContractConfig),
    ("contract.observations[]", schema.ObservationSpec),
    ("contract.observations[].align", schema.Align),
    ("contract.observations[].image", schema.ImageSpec),
    ("contract.actions[]", schema.ActionSpec),
    ("contract.signals[]", schema.SignalSpec),
    ("control_modes.NAME.inference", schema.Inference),
    ("control_modes.NAME.dispatch", schema.Dispatch),
    ("control_modes.NAME.dispatch.smoothing", schema.Smoothing),
    ("control", schema.Control),
    ("metrics", schema.MetricsConfig),
)


def type_name(hint: Any) -> str:
    """A type as a reader of YAML would call it."""
    if isinstance(hint, type) and not get_args(hint):
        return hint.__name__
    return re.sub(r"\b(?:[a-z_]+\.)+(?=\w)", "", str(hint))


def default(field: attrs.Attribute[Any]) -> str:
    """A field's default, or that it is required."""
    if field.default is attrs.NOTHING:
        return "required"
    if isinstance(field.default, attrs.Factory):  # type: ignore[arg-type]
        return "as below" if attrs.has(field.default.factory) else "empty"
    return f"`{field.default!r}`"


def allowed(metadata: Any) -> str:
    """Range or choices of a field."""
    if metadata.get("secret"):
        return "secret: `${NAME}`"
    if metadata.get("choices"):
        return ", ".join(f"`{choice}`" for choice in metadata["choices"])
    signs = (("ge", "≥"), ("gt", ">"), ("le", "≤"), ("lt", "<"))
    return " ".join(f"{sign} {metadata[key]:g}" for key, sign in signs if metadata.get(key) is not None)


def config_page() -> Iterator[str]:
    """Lines of the page on the robot YAML."""
    yield "# The robot YAML\n"
    yield "Every section, its keys, units and defaults. Unknown keys are errors. Sections with a `type` take, besides,"
    yield "the options of that plugin, which `ibrobot plugins show TYPE` prints.\n"
    yield "`${NAME:default}` is replaced from the environment, `~` by the home directory, and `package://PACKAGE/path`"
    yield "by where that Python package is.\n"
    for path, section in SECTIONS:
        hints = get_type_hints(section)
        yield f"## `{path}`\n"
        yield (section.__doc__ or "").strip().splitlines()[0] + "\n"
        yield "| key | type | unit | default | allowed | |"
        yield "|---|---|---|---|---|---|"
        for field in attrs.fields(section):
            meta = field.metadata
            cells = (f"`{field.name}`", f"`{type_name(hints[field.name])}`", meta.get("unit", ""), default(field))
            yield (
                "| " + " | ".join((*(c.replace("|", r"\|") for c in cells), allowed(meta), meta.get("help", ""))) + " |"
            )
        yield ""


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
    for name, lines in (("config.md", config_page()), ("cli.md", cli_page()), ("plugins.md", plugin_page())):
        text = "\n".join(lines) + "\n"
        path = directory / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
