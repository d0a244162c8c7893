"""`ibrobot contract init`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.api import RecorderError
from ibrobot_core.app import EpisodePath, echo, wrong_input


@click.group()
def contract() -> None:
    """Contracts for foreign bags."""


@contract.command()
@click.argument("bag", type=EpisodePath())
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The new file; by default, print the contract.")
@wrong_input()
def init(bag: Path, output: Path | None) -> None:
    """Draft a contract for BAG from its topics and their first messages.

    The draft is a YAML file for `ibrobot convert --config`. Lines marked CHOOSE need a decision: read them all.
    """
    from ibrobot_mcap.commands.find_episodes import opened
    from ibrobot_mcap.draft import draft

    with opened(bag) as reader:
        text = draft(reader)
    if output is None:
        echo(text, nl=False)
        return
    try:
        with output.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise RecorderError(f"{output}: cannot be written: {error.strerror}") from error
    echo(f"{output}: read it, then ibrobot convert {bag} --config {output} --out DATASET")
