"""A plugin with a command whose options a shell completes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import attrs

from ibrobot_core.api import hookimpl, option
from ibrobot_core.app import Command


@attrs.frozen(kw_only=True)
class Feed:
    """Feed the robot with an EPISODE."""

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")
    what: str = option("milk", choices=("milk", "mash"), help="what it gets")
    source: str = option("bowl", typed="--from WHERE", choices=("bowl", "bottle"), open=True, help="where it is")

    def __call__(self) -> None:
        """Do nothing."""


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot feed`."""
    yield Command("feed", Feed)
