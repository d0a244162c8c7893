"""The plugin's hooks: the command `ibrobot convert`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Command, hookimpl

if TYPE_CHECKING:
    import click


def _convert() -> click.Command:
    from ibrobot_data.command import convert

    return convert


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot convert`."""
    yield Command("convert", "Make a dataset for training from episodes.", _convert)
