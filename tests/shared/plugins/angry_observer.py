"""A plugin that raises at each event."""

from __future__ import annotations

from ibrobot_core import hookimpl


@hookimpl
def ibrobot_episode_started() -> None:
    raise ValueError("not again")


@hookimpl
def ibrobot_episode_ended() -> None:
    raise ValueError("not again")
