"""`ibrobot plugins` and `ibrobot plugins show TYPE`: list installed and broken plugins, and options of types."""

from __future__ import annotations

import json
import sys
from typing import Any

import attrs

from ibrobot_core.api import did_you_mean, option
from ibrobot_core.app import Registry, RequestError, echo, installed_plugins


@attrs.frozen
class ListPlugins:
    """List the types of the installed plugins, their missing dependencies, and broken plugins."""

    def __call__(self) -> dict[str, list[Any]]:
        """Rows of all types, and the failures of plugins."""
        registry = installed_plugins()
        rows = [_row(registry, key) for key in sorted(registry.entries)]
        return {"plugins": rows, "broken": registry.failures}

    def show(self, listed: dict[str, list[Any]]) -> None:
        """Print a table."""
        columns = ("kind", "type", "package", "version", "summary")
        _print_table(columns, [[str(row[column]) for column in columns] for row in listed["plugins"]])
        for row in listed["plugins"]:
            if row["missing"] is not None:
                echo(f"lacking: {row['kind']} {row['type']}: {_lacking(row)}")
        for failure in listed["broken"]:
            echo(f"broken: {failure}")


@attrs.frozen
class ShowPlugin:
    """Print the options of TYPE.

    If several kinds have a type of this name, it prints the options of each.
    """

    type: str = option(typed="TYPE", help="the value of `type` in a robot YAML")

    def __call__(self) -> list[dict[str, Any]]:
        """The rows of the type, with its options."""
        from ibrobot_terminal.describe import described

        registry = installed_plugins()
        keys = [key for key in sorted(registry.entries) if key[1] == self.type]
        if not keys:
            remark = did_you_mean(self.type, sorted({t for _, t in registry.entries}), "installed")
            raise RequestError(f"unknown type {self.type!r}{remark}{registry.broken}")
        options = {key: list(described(registry.entries[key].descriptor.options)) for key in keys}
        return [{**_row(registry, key), "options": options[key]} for key in keys]

    def show(self, matching: list[dict[str, Any]]) -> None:
        """Print a table for each type."""
        columns = ("name", "type", "unit", "default", "allowed", "help")
        printed: dict[str, Any] = {}
        for one in matching:
            echo(f"{one['kind']} type {one['type']} ({one['package']} {one['version']}): {one['summary']}")
            if one["missing"] is not None:
                echo(f"lacking: {_lacking(one)}")
            rows = [[_text(getattr(each, column)) for column in columns] for each in one["options"]]
            same = next((kind for kind, earlier in printed.items() if earlier == rows), None)
            if not rows:
                echo("no options")
            elif same is not None:
                echo(f"its options are those of {same} type {one['type']}")
            else:
                _print_table(columns, rows)
                printed[one["kind"]] = rows


def _row(registry: Registry, key: tuple[str, str]) -> dict[str, Any]:
    entry = registry.entries[key]
    missing = None if key in registry.doubles else registry.missing(*key)
    lacking = missing and {"what": missing.missing, "apt": list(missing.apt), "remedy": missing.remedy}
    return {
        "kind": key[0],
        "type": key[1],
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

    from ibrobot_terminal.screen import Screen

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, no_wrap=column in ("kind", "name"), overflow="fold")
    for row in rows:
        table.add_row(*row)
    Screen(width=None if sys.stdout.isatty() else 1000).print(table)
