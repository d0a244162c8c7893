"""`ibrobot episodes repair`."""

from __future__ import annotations

from contextlib import suppress

import click

from ibrobot_core.api import EpisodeSummary, RecorderError
from ibrobot_core.app import Failed, InUse, declared, echo, emit, wrong_input
from ibrobot_mcap import REPAIR
from ibrobot_mcap.changes import Changed, RepairOptions
from ibrobot_mcap.commands.report import report


@click.command()
@declared(REPAIR)
@wrong_input()
def repair(options: RepairOptions, events: bool) -> None:
    """Repair unfinished or incomplete episodes in PATH.

    It writes index and metadata.yaml for the readable part. The episode records the missing messages, and `verify`
    reports them. The outcome becomes unknown, since the end may be missing: look at the episode, and set it with
    `mark`. The original is removed only after the new episode has been read back and has all its messages.
    Interrupted trims, repairs and deletions are finished.
    """
    from ibrobot_mcap import rewrite
    from ibrobot_mcap.commands.find_episodes import duration_s, episodes_in
    from ibrobot_mcap.owning import interrupted, owning

    path, failed = options.path, 0
    for episode in interrupted(path):
        with suppress(InUse), owning(episode, "is being repaired"):
            report(REPAIR, Changed(str(episode), "an interrupted change is finished"), events=events)
    for episode in episodes_in(path):
        try:
            made = rewrite.repair(episode)
        except (RecorderError, InUse) as error:
            failed += 1
            if events:
                emit(REPAIR, Failed(str(error)))
            else:
                echo(f"error: {error}", err=True)
            continue
        what = "is whole"
        if made is not None:
            count = sum(topic.count for topic in made.summary.topics.values())
            what = f"repaired, {count} messages, {duration_s(made.summary):.2f} s{_description(made.summary)}"
        report(REPAIR, Changed(str(episode), what), events=events)
    if failed:
        raise SystemExit(1)


def _description(summary: EpisodeSummary) -> str:
    """A remark on missing messages and the former outcome."""
    from ibrobot_mcap.commands.find_episodes import stated_outcome_text

    missing = sum(topic.missing for topic in summary.topics.values())
    return (f", {missing} are missing" if missing else "") + stated_outcome_text(summary)
