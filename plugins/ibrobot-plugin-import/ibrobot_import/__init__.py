"""The plugin's hooks: `ibrobot config import`, and the formats that it reads."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import hookimpl
from ibrobot_core.app import Command, ForeignConfig
from ibrobot_import.formats import FORMATS

if TYPE_CHECKING:
    import click

_COMMAND = "config import"


def _import() -> click.Command:
    from ibrobot_import.command import import_

    return import_


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot config import`."""
    yield Command(_COMMAND, "Make a robot YAML from a config of IB-Robot, Rosetta or LeRobot.", _import)


@hookimpl
def ibrobot_foreign_configs() -> Iterable[ForeignConfig]:
    """The formats that `ibrobot config import` reads."""
    for each in FORMATS:
        yield ForeignConfig(each.name, each.reads, _COMMAND)
