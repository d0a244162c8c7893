"""`ibrobot episodes …`: manages recorded episodes."""

from __future__ import annotations

import click

from ibrobot_mcap.commands.answers import answers
from ibrobot_mcap.commands.change import delete, mark, repair, trash_command, trim
from ibrobot_mcap.commands.export import export
from ibrobot_mcap.commands.list_episodes import info, list_episodes
from ibrobot_mcap.commands.plot import plot
from ibrobot_mcap.commands.verify import verify


@click.group()
def episodes() -> None:
    """List, check, repair, mark, trim, export and delete recorded episodes.

    An episode is a folder such as episodes/pick_cube/episodes/episode_000001. Commands that take several episodes also
    accept a dataset, or the folder of all datasets.
    """


for command in (list_episodes, info, answers, verify, repair, mark, plot, trim, export, delete, trash_command):
    episodes.add_command(command)
