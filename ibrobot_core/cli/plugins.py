"""`ibrobot plugins` and `ibrobot plugins show TYPE`: list installed and broken plugins, and options of types."""

from __future__ import annotations

import json
import sys
from typing import Any

import attrs
import click

from ibrobot_core.errors import PluginError
from ibrobot_core.options import did_you_mean
from ibrobot_core.plugins import Entry, Registry, installed_plugins
from ibrobot_core.safe_output import echo


@click.group(invoke_without_command=True)
@click.option("--json", "as_json", is_flag=True, help="Print {plugins: […], broken: […]}.")
@click.pass_context
def plugins(ctx: click.Context, as_json: bool) -> None:
    """List the types of the installed plugins, their missing dependencies, and broken plugins."""
    if ctx.invoked_subcommand is not None:
        return
    registry = installed_plugins()
    rows = [_row(registry, registry.entries[key]) for key in sorted(registry.entries)]
    if as_json:
        broken = [attrs.asdict(failure) for failure in registry.failures]
        echo(json.dumps({"plugins": rows, "broken": broken}, indent=2))
        return
    columns = ("kind", "type", "package", "version", "summary")
    _print_table(columns, [[str(row[column]) for column in columns] for row in rows])
    for row in rows:
        if row["missing"] is not None:
            echo(f"lacking: {row['kind']} {row['type']}: {_lacking(row)}")
    for failure in registry.failures:
        echo(f"broken: {failure}")


@plugins.command()
@click.argument("type_", metavar="TYPE")
@click.option("--json", "as_json", is_flag=True, help="Print a list of {kind, type, …, options: […]}.")
def show(type_: str, as_json: bool) -> None:
    """Print the options of TYPE.

    If several kinds have a type of this name, it prints the options of each.
    """
    from ibrobot_core.config.describe import described

    registry = installed_plugins()
    entries = [registry.entries[key] for key in sorted(registry.entries) if key[1] == type_]
    if not entries:
        remark = did_you_mean(type_, sorted({t for _, t in registry.entries}), "installed")
        raise PluginError(f"unknown type {type_!r}{remark}{registry.broken}")
    matching = [
        {**_row(registry, entry), "options": [attrs.asdict(option) for option in described(entry.descriptor.options)]}
        for entry in entries
    ]
    if as_json:
        echo(json.dumps(matching, indent=2))
        return
    columns = ("name", "type", "unit", "default", "allowed", "help")
    for one in matching:
        echo(f"{one['kind']} type {one['type']} ({one['package']} {one['version']}): {one['summary']}")
        if one["missing"] is not None:
            echo(f"lacking: {_lacking(one)}")
        if one["options"]:
            _print_table(columns, [[_text(option[column]) for column in columns] for option in one["options"]])
        else:
            echo("no options")


def _row(registry: Registry, entry: Entry) -> dict[str, Any]:
    missing = registry.missing(entry.kind, entry.descriptor.type)
    lacking = missing and {"what": missing.missing, "apt": list(missing.apt), "remedy": missing.remedy}
    return {
        "kind": entry.kind,
        "type": entry.descriptor.type,
        "package": entry.package,
        "version": entry.version,
        "summary": entry.descriptor.summary,
        "missing": lacking,
    }


def _lacking(row: dict[str, Any]) -> str:
    return f"{row['missing']['what']}; {row['missing']['remedy']}"


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _print_table(columns: tuple[str, ...], rows: list[list[str]]) -> None:
    """Print a table as wide as the terminal; without a terminal, print all cells in full."""
    from rich.table import Table

    from ibrobot_core.screen import Screen

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, no_wrap=column in ("kind", "name"), overflow="fold")
    for row in rows:
        table.add_row(*row)
    Screen(width=None if sys.stdout.isatty() else 1000).print(table)
