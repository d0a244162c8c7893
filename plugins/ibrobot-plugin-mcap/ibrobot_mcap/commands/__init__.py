"""`ibrobot episodes …`: manages recorded episodes; one file per command."""

from __future__ import annotations

import click

from ibrobot_mcap.commands.answers import answers
from ibrobot_mcap.commands.delete import delete
from ibrobot_mcap.commands.export import export
from ibrobot_mcap.commands.info import info
from ibrobot_mcap.commands.list_episodes import list_episodes
from ibrobot_mcap.commands.mark import mark
from ibrobot_mcap.commands.plot import plot
from ibrobot_mcap.commands.repair import repair
from ibrobot_mcap.commands.trash import trash_command
from ibrobot_mcap.commands.trim import trim
from ibrobot_mcap.commands.verify import verify


@click.group()
def episodes() -> None:
    """List, check, repair, mark, trim, export and delete recorded episodes.

    An episode is a folder such as episodes/pick_cube/episodes/episode_000001. Commands that take several episodes also
    accept a dataset, or the folder of all datasets.
    """


for command in (list_episodes, info, answers, verify, repair, mark, plot, trim, export, delete, trash_command):
    episodes.add_command(command)
