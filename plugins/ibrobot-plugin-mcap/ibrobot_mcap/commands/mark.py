"""`ibrobot episodes mark`."""

from __future__ import annotations

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import declared, wrong_input
from ibrobot_mcap import MARK
from ibrobot_mcap.changes import Changed, MarkOptions
from ibrobot_mcap.commands.report import report


@click.command()
@declared(MARK)
@wrong_input()
def mark(options: MarkOptions, events: bool) -> None:
    """Set the OUTCOME of EPISODES, e.g. after a repair. The episode records that its outcome was set by hand."""
    from ibrobot_mcap.bag_metadata import set_custom
    from ibrobot_mcap.commands.find_episodes import opened
    from ibrobot_mcap.metadata import MARKED, OUTCOME
    from ibrobot_mcap.owning import owning

    for episode in options.episodes:
        with owning(episode, "is being marked"):
            with opened(episode) as reader:
                whole = episode.is_dir() and reader.finished and not reader.short()
            if not whole:
                raise RecorderError(f"{episode}: is unfinished, or lacks messages; run `ibrobot episodes repair` first")
            set_custom(episode, {OUTCOME: options.outcome, MARKED: "true"})
        report(MARK, Changed(str(episode), options.outcome), events=events)
