"""`ibrobot episodes delete`."""

from __future__ import annotations

import click

from ibrobot_core.app import Declined, declared, echo, wrong_input
from ibrobot_mcap import DELETE
from ibrobot_mcap.changes import Changed, DeleteOptions
from ibrobot_mcap.commands.report import report


@click.command()
@declared(DELETE)
@wrong_input()
def delete(options: DeleteOptions, events: bool) -> None:
    """Delete EPISODES after asking. Other folders are never deleted.

    After --to-trash, `ibrobot episodes trash --restore` brings them back.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.ask import confirmed
    from ibrobot_mcap.commands.find_episodes import size_of, size_text

    for episode in options.episodes:
        trash.check_is_episode(episode)
    for episode in options.episodes:
        if options.to_trash:
            trashed = trash.discard(episode)
            if not events:
                echo(f"to undo: ibrobot episodes trash {episode.parent} --restore {trashed.id}", err=True)
            report(DELETE, Changed(str(episode), f"moved to {trash.TRASH}"), events=events)
            continue
        if not (options.yes or confirmed(f"delete {episode} ({size_text(size_of(episode))})?")):
            raise Declined
        trash.delete(episode)
        report(DELETE, Changed(str(episode), "deleted"), events=events)
