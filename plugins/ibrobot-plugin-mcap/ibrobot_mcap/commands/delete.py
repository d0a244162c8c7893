"""`ibrobot episodes delete`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import Declined, EpisodePath, echo, wrong_input


@click.command()
@click.argument("episodes", type=EpisodePath(), nargs=-1, required=True)
@click.option("--yes", is_flag=True, help="Do not ask.")
@click.option("--to-trash", is_flag=True, help="Move them to .trash beside them, without asking.")
@wrong_input()
def delete(episodes: tuple[Path, ...], yes: bool, to_trash: bool) -> None:
    """Delete EPISODES after asking. Other folders are never deleted.

    After --to-trash, `ibrobot episodes trash --restore` brings them back.
    """
    from ibrobot_mcap import trash
    from ibrobot_mcap.commands.ask import agree
    from ibrobot_mcap.commands.find_episodes import size_of, told_size
    from ibrobot_mcap.reader import is_rosbag2

    for episode in episodes:
        if not (episode.is_dir() and is_rosbag2(episode)):
            raise RecorderError(f"{episode}: is not an episode; nothing was deleted")
    for episode in episodes:
        if to_trash:
            trashed = trash.discard(episode)
            echo(f"to undo: ibrobot episodes trash {episode.parent} --restore {trashed.id}", err=True)
            echo(f"{episode}: moved to {trash.TRASH}")
            continue
        if not (yes or agree(f"delete {episode} ({told_size(size_of(episode))})?")):
            raise Declined
        trash.delete(episode)
        echo(f"{episode}: deleted")
