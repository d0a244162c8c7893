"""`ibrobot episodes list` and `info`."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import attrs
from ibrobot_terminal.plural import counted
from ibrobot_terminal.screen import Screen, styled
from rich.table import Table

from ibrobot_core.api import EpisodeAddress, EpisodeSummary, RecorderError, option
from ibrobot_core.app import Unsuccessful, echo, wrong_input

_WIDE = 100
"""Width of a terminal with enough room for prompts and years [columns]."""
_LONG = 200
"""For longer metadata, only the length is printed [characters]."""


@attrs.frozen(kw_only=True)
class ListEpisodes:
    """List the episodes in PATH.

    PATH is a folder of datasets (by default `episodes`), a dataset, or an episode. All commands take the names that it
    prints, e.g. pick:1.
    """

    path: Path = option(Path("episodes"), typed="PATH", names="episodes", help="an episode, or a folder of them")

    @wrong_input()
    def __call__(self) -> list[dict[str, Any]]:
        from ibrobot_mcap.commands.find_episodes import (
            date_of,
            duration_s,
            episodes_in,
            interrupted_lines,
            size_of,
            summary_of,
        )

        for line in interrupted_lines(self.path):
            echo(line, err=True)
        rows = []
        problems = []
        for episode in episodes_in(self.path):
            try:
                summary = summary_of(episode)
            except RecorderError as error:
                problems.append(str(error))
                continue
            rows.append({
                "path": str(episode), "date": date_of(summary), "mode": summary.metadata.get("mode", ""),
                "prompt": summary.metadata.get("prompt", ""), "duration_s": round(duration_s(summary), 2),
                "messages": sum(topic.count for topic in summary.topics.values()),
                "dropped": sum(topic.dropped for topic in summary.topics.values()),
                "outcome": summary.outcome, "finished": summary.finished, "bytes": size_of(episode),
            })  # fmt: skip
        for problem in problems:
            echo(f"unreadable: {problem}", err=True)
        if problems:
            raise Unsuccessful(rows)
        return rows

    def show(self, rows: list[dict[str, Any]]) -> None:
        """Print a table."""
        from ibrobot_mcap.commands.find_episodes import size_text

        console = Screen(width=None if sys.stdout.isatty() else 1000)
        table = Table(box=None, padding=(0, 1))
        wide = console.width >= _WIDE
        prompts = ("prompt",) if wide else ()
        began = "began (UTC)" if wide else "began"
        for heading in ("episode", began, "s", "messages", "lost", "outcome", "size", *prompts):
            right = heading in ("s", "messages", "lost", "size")
            table.add_column(heading, justify="right" if right else "left", no_wrap=heading != "prompt")
        for row in rows:
            table.add_row(
                _short_name(Path(row["path"])),
                row["date"][0 if wide else 5 :],
                f"{row['duration_s']:.1f}",
                str(row["messages"]),
                str(row["dropped"]),
                row["outcome"] if row["finished"] else styled("unfinished", "red"),
                size_text(row["bytes"]),
                *([row["prompt"]] if prompts else []),
            )
        console.print(table)


def _short_name(episode: Path) -> str:
    """The shortest name of an episode that every command takes: `EpisodeAddress.find` gives its path."""
    numbered = re.fullmatch(r"episode_(\d{6,})", episode.name)
    if numbered is not None and episode.parent.name == "episodes":
        dataset = episode.parents[1]
        for name in (dataset.name, str(dataset)):
            short = f"{name}:{int(numbered[1])}"
            if EpisodeAddress.find(Path(short)) == episode:
                return short
    return str(episode)


@attrs.frozen(kw_only=True)
class ShowEpisode:
    """Show topics, counts, losses and metadata of an EPISODE.

    The episode may be unfinished.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")

    @wrong_input()
    def __call__(self) -> EpisodeSummary:
        from ibrobot_mcap.commands.find_episodes import summary_of

        return summary_of(self.episode)

    def show(self, summary: EpisodeSummary) -> None:
        """Print a table of topics, and the metadata."""
        from ibrobot_mcap.commands.find_episodes import date_of, duration_s, size_of, size_text

        console = Screen(width=None if sys.stdout.isatty() else 1000)
        state = summary.outcome if summary.finished else "unfinished; `ibrobot episodes repair` makes it whole"
        console.print(f"{self.episode}: {state}", soft_wrap=True)
        empty = not any(topic.count for topic in summary.topics.values())
        began = "no messages" if empty else f"{date_of(summary)} UTC" if date_of(summary) else "without a date"
        console.print(f"{began}, {duration_s(summary):.2f} s, {size_text(size_of(self.episode))}")
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
                console.print(f"{name}: lacks {counted(topic.missing, 'message')} of the recorder", soft_wrap=True)
        for key, value in summary.metadata.items():
            shown = value if len(value) <= _LONG else f"({len(value)} characters; --json shows them)"
            console.print(f"{key}: {shown}", soft_wrap=True)
