"""`ibrobot episodes trim`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.app import declared, echo, wrong_input
from ibrobot_mcap import TRIM
from ibrobot_mcap.changes import Changed, TrimOptions
from ibrobot_mcap.commands.report import report


@click.command()
@declared(TRIM)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The new episode.")
@wrong_input()
def trim(options: TrimOptions, output: Path | None, events: bool) -> None:
    """Copy a part of an EPISODE to a new one.

    Times are in seconds from its first message. Without the end of the episode, the outcome is unknown: set it with
    `mark`. The last message of a latched topic before this part is kept, because a late subscriber would have received
    it. After --in-place, `ibrobot episodes trash --restore` puts the original back.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.find_episodes import duration_s, opened, stated_outcome_text

    episode, begin_s, end_s = options.episode, options.begin_s, options.end_s
    if options.in_place == (output is not None):
        raise click.UsageError("give either --output or --in-place")
    with opened(episode):  # raises the error for what is not an episode
        pass
    if output is None:
        made, trashed = trash.trim(episode, begin_s, end_s)
        if not events:
            echo(f"to undo: ibrobot episodes trash {episode.parent} --restore {trashed.id}", err=True)
    else:
        made = trash.copy_part(episode, output, begin_s, end_s)
    count = sum(topic.count for topic in made.summary.topics.values())
    what = f"{count} messages, {duration_s(made.summary):.2f} s{stated_outcome_text(made.summary)}"
    report(TRIM, Changed(str(made.path), what), events=events)
