"""`ibrobot episodes repair`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.errors import RecorderError


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
def repair(path: Path) -> None:
    """Make unfinished episodes in PATH whole: the file's index and metadata.yaml, from all that was written.

    Only what the recorder had not written when it was killed is lost. An original is removed when the new episode has
    been read back and has every message of it.
    """
    from ibrobot_mcap import rewrite
    from ibrobot_mcap.commands.found import duration_s, episodes_in

    failed = 0
    for episode in episodes_in(path):
        try:
            made = rewrite.repair(episode)
        except RecorderError as error:
            failed += 1
            click.echo(f"error: {error}", err=True)
            continue
        if made is None:
            click.echo(f"{episode}: is whole")
        else:
            count = sum(topic.count for topic in made.summary.topics.values())
            click.echo(f"{episode}: repaired, {count} messages, {duration_s(made.summary):.2f} s")
    if failed:
        raise SystemExit(1)
