"""`ibrobot episodes verify`."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.app import EpisodePath, echo, wrong_input


@click.command()
@click.argument("path", type=EpisodePath())
@click.option("--gap", type=click.FloatRange(min=1), default=5.0, show_default=True, help="Longest pause, in periods.")
@wrong_input()
def verify(path: Path, gap: float) -> None:
    """Check every message of the episodes in PATH.

    Prints problems, and exits with 1 if there are any.

    Problems are: unfinished episodes, messages that cannot be decoded, counts that differ from metadata.yaml, lost
    messages, topics of the contract without messages, header stamps that decrease, pauses in a topic longer than --gap
    times its median period, and different contracts within one dataset.
    """
    from ibrobot_mcap.checks import problems_of
    from ibrobot_mcap.commands.find_episodes import episodes_in, summary_of

    bad = 0
    contracts: dict[Path, tuple[str, Path]] = {}
    for episode in episodes_in(path):
        problems = problems_of(episode, gap)
        fingerprint = summary_of(episode).metadata.get("fingerprint", "")
        first, where = contracts.setdefault(episode.parent, (fingerprint, episode))
        if fingerprint != first:
            problems.append(f"its contract is {fingerprint[:12]}, that of {where.name} is {first[:12]}")
        bad += bool(problems)
        echo(f"{episode}: {'; '.join(problems) or 'good'}")
    if bad:
        raise SystemExit(1)
