"""`ibrobot episodes trim`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.api import RecorderError, echo, wrong_input


@click.command()
@click.argument("episode", type=click.Path(path_type=Path))
@click.option("--from", "begin_s", type=click.FloatRange(min=0), default=0.0, show_default=True, help="[s]")
@click.option("--to", "end_s", type=click.FloatRange(min=0), help="End [s]; by default the end of the episode.")
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The new episode.")
@wrong_input()
def trim(episode: Path, begin_s: float, end_s: float | None, output: Path) -> None:
    """Copy a part of an EPISODE to a new one, in seconds from its first message.

    The last message of a latched topic before this part is kept, because a late subscriber would have received it.
    """
    from ibrobot_core.api import ns
    from ibrobot_mcap.commands.found import duration_s, summary_of
    from ibrobot_mcap.rewrite import rewrite

    summary = summary_of(episode)
    length_s = duration_s(summary)
    last_s = length_s if end_s is None else end_s
    if not begin_s < last_s <= length_s:
        raise RecorderError(f"{episode}: is {length_s:.2f} s long; --from {begin_s:g} --to {last_s:g} is outside it")
    start_ns = summary.start_ns
    made = rewrite(
        episode, output, begin_ns=start_ns + ns(begin_s), end_ns=start_ns + ns(last_s),
        marks={"trimmed": f"{begin_s:g} s to {last_s:g} s of {episode.name}"},
    )  # fmt: skip
    count = sum(topic.count for topic in made.summary.topics.values())
    echo(f"{output}: {count} messages, {duration_s(made.summary):.2f} s")
