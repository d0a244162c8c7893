"""Two commands: one that core has, and one that any other copy of this plugin has, too."""

from __future__ import annotations

from collections.abc import Iterator

import click

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command


@hookimpl
def ibrobot_commands() -> Iterator[Command]:
    yield Command("doctor", "treats another patient", lambda: click.Command("doctor"))
    yield Command("juggle", f"juggles, as {__name__} does", lambda: click.Command("juggle"))
