"""Two commands: one that core has, and one that any other copy of this plugin has, too."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command


@hookimpl
def ibrobot_commands() -> Iterator[Command]:
    yield Command("doctor", summary="treats another patient")
    yield Command("juggle", summary=f"juggles, as {__name__} does")
