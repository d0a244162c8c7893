"""Commands below one of another package."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import Command


@hookimpl
def ibrobot_commands() -> Iterator[Command]:
    yield Command("plugins check", summary="checks")
    yield Command("plugins new", summary="makes")
