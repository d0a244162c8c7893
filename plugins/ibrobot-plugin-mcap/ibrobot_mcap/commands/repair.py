"""`ibrobot episodes repair`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click

from ibrobot_core.api import EpisodeSummary, RecorderError
from ibrobot_core.app import EpisodePath, InUse, echo, wrong_input


@click.command()
@click.argument("path", type=EpisodePath())
@wrong_input()
def repair(path: Path) -> None:
    """Repair unfinished or incomplete episodes in PATH.

    It writes index and metadata.yaml for the readable part. The episode records the missing messages, and `verify`
    reports them. The outcome becomes unknown, since the end may be missing: look at the episode, and set it with
    `mark`. The original is removed only after the new episode has been read back and has all its messages. Trims,
    repairs and deletions that were interrupted are finished.
    """
    from ibrobot_mcap import rewrite
    from ibrobot_mcap.commands.find_episodes import duration_s, episodes_in
    from ibrobot_mcap.owning import interrupted, owning

    failed = 0
    for episode in interrupted(path):
        with suppress(InUse), owning(episode, "is being repaired"):
            echo(f"{episode}: an interrupted change is finished")
    for episode in episodes_in(path):
        try:
            made = rewrite.repair(episode)
        except (RecorderError, InUse) as error:
            failed += 1
            echo(f"error: {error}", err=True)
            continue
        if made is None:
            echo(f"{episode}: is whole")
        else:
            count = sum(topic.count for topic in made.summary.topics.values())
            echo(f"{episode}: repaired, {count} messages, {duration_s(made.summary):.2f} s{_description(made.summary)}")
    if failed:
        raise SystemExit(1)


def _description(summary: EpisodeSummary) -> str:
    """A description of missing messages, and the former outcome."""
    from ibrobot_mcap.commands.find_episodes import told_stated

    missing = sum(topic.missing for topic in summary.topics.values())
    return (f", {missing} are missing" if missing else "") + told_stated(summary)
