"""`ibrobot episodes mark`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import EpisodePath, echo, wrong_input


@click.command()
@click.argument("episodes", nargs=-1, required=True, type=EpisodePath())
@click.argument("outcome", type=click.Choice(("success", "failure", "unknown")))
@wrong_input()
def mark(episodes: tuple[Path, ...], outcome: str) -> None:
    """Set the OUTCOME of EPISODES, e.g. after a repair. The episode records that its outcome was set by hand."""
    from ibrobot_mcap.bag_metadata import set_custom
    from ibrobot_mcap.commands.find_episodes import opened
    from ibrobot_mcap.metadata import MARKED, OUTCOME
    from ibrobot_mcap.owning import owning

    for episode in episodes:
        with owning(episode, "is being marked"):
            with opened(episode) as reader:
                whole = episode.is_dir() and reader.finished and not reader.short()
            if not whole:
                raise RecorderError(f"{episode}: is unfinished, or lacks messages; run `ibrobot episodes repair` first")
            set_custom(episode, {OUTCOME: outcome, MARKED: "true"})
        echo(f"{episode}: {outcome}")
