"""The plugin's hook: `ibrobot config import`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import hookimpl
from ibrobot_core.app import Command
from ibrobot_import.formats import FORMATS

if TYPE_CHECKING:
    import click


def _import() -> click.Command:
    from ibrobot_import.command import import_

    return import_


def _takes(values: Mapping[str, Any]) -> str:
    return next((each.name for each in FORMATS if each.reads(values)), "")


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot config import`."""
    summary = "Make a robot YAML from a config of IB-Robot, Rosetta or LeRobot."
    yield Command("config import", summary, _import, takes=_takes)
