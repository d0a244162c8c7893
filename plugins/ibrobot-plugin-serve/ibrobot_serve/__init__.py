"""The plugin's hooks: the command `ibrobot serve`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Command, hookimpl

if TYPE_CHECKING:
    import click


def _serve() -> click.Command:
    from ibrobot_serve.command import serve

    return serve


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot serve`."""
    yield Command("serve", "Run a model for robots elsewhere.", _serve)
