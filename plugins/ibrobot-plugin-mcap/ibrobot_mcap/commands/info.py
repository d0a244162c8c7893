"""`ibrobot episodes info`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import attrs
import click
from rich.table import Table

from ibrobot_core.app import EpisodePath, Screen, echo, wrong_input

_LONG = 200
"""For longer metadata, only the length is printed [characters]."""


@click.command()
@click.argument("episode", type=EpisodePath())
@click.option("--json", "as_json", is_flag=True, help="Print JSON, with all metadata.")
@wrong_input()
def info(episode: Path, as_json: bool) -> None:
    """Show topics, counts, losses and metadata of an EPISODE.

    The episode may be unfinished.
    """
    from ibrobot_mcap.commands.find_episodes import date_of, duration_s, size_of, size_text, summary_of

    summary = summary_of(episode)
    if as_json:
        echo(json.dumps(attrs.asdict(summary), indent=2, default=str))
        return
    console = Screen(width=None if sys.stdout.isatty() else 1000)
    state = summary.outcome if summary.finished else "unfinished; `ibrobot episodes repair` makes it whole"
    console.print(f"{episode}: {state}", soft_wrap=True)
    began = f"{date_of(summary)} UTC" if date_of(summary) else "no messages"
    console.print(f"{began}, {duration_s(summary):.2f} s, {size_text(size_of(episode))}")
    table = Table(box=None, padding=(0, 1))
    for heading in ("topic", "type", "messages", "Hz", "lost"):
        # Names are folded rather than truncated, because `export` needs complete ones.
        left = heading in ("topic", "type")
        table.add_column(heading, justify="left" if left else "right", overflow="fold", no_wrap=not left)
    span_s = duration_s(summary)
    for name, topic in summary.topics.items():
        rate = f"{(topic.count - 1) / span_s:.1f}" if span_s and topic.count > 1 else ""
        table.add_row(name, topic.type, str(topic.count), rate, str(topic.dropped or ""))
    console.print(table)
    for name, topic in summary.topics.items():
        if topic.missing:
            console.print(f"{name}: {topic.missing} messages that the recorder wrote are missing", soft_wrap=True)
    for key, value in summary.metadata.items():
        shown = value if len(value) <= _LONG else f"({len(value)} characters; --json shows them)"
        console.print(f"{key}: {shown}", soft_wrap=True)
