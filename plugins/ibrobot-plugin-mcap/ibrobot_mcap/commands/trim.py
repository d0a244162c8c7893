"""`ibrobot episodes trim`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.app import EpisodePath, echo, wrong_input


@click.command()
@click.argument("episode", type=EpisodePath())
@click.option("--from", "begin_s", type=click.FloatRange(min=0), default=0.0, show_default=True, help="Start [s].")
@click.option("--to", "end_s", type=click.FloatRange(min=0), help="End [s]; by default the end of the episode.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The new episode.")
@click.option("--in-place", is_flag=True, help="Replace EPISODE; the original moves to .trash beside it.")
@wrong_input()
def trim(episode: Path, begin_s: float, end_s: float | None, output: Path | None, in_place: bool) -> None:
    """Copy a part of an EPISODE to a new one.

    Times are in seconds from its first message. Without the end of the episode, the outcome is unknown: set it with
    `mark`. The last message of a latched topic before this part is kept, because a late subscriber would have received
    it. After --in-place, `ibrobot episodes trash --restore` puts the original back.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.find_episodes import duration_s, opened, told_stated

    if in_place == (output is not None):
        raise click.UsageError("give either --output or --in-place")
    with opened(episode):  # explains what an episode is
        pass
    if output is None:
        made, trashed = trash.trim(episode, begin_s, end_s)
        echo(f"to undo: ibrobot episodes trash {episode.parent} --restore {trashed.id}", err=True)
    else:
        made = trash.copy_part(episode, output, begin_s, end_s)
    count = sum(topic.count for topic in made.summary.topics.values())
    echo(f"{made.path}: {count} messages, {duration_s(made.summary):.2f} s{told_stated(made.summary)}")
