"""The plugin's hooks: the commands `ibrobot convert`, `ibrobot record` and `ibrobot replay`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Command, hookimpl

if TYPE_CHECKING:
    import click


def _convert() -> click.Command:
    from ibrobot_data.command import convert

    return convert


def _record() -> click.Command:
    from ibrobot_data.record import record

    return record


def _replay() -> click.Command:
    from ibrobot_data.replay import replay

    return replay


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot convert`, `ibrobot record` and `ibrobot replay`."""
    yield Command("convert", "Make a dataset for training from episodes.", _convert)
    yield Command("record", "Run a robot and record its episodes.", _record)
    yield Command("replay", "Play a recorded episode on a robot, and compare.", _replay)
