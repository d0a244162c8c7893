"""What is on the disk of the episodes of a run, read back once they are written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import EpisodeSummary, IbrobotError, seconds
from ibrobot_core.app import RunView, error_text


@attrs.frozen
class WrittenEpisode:
    """An episode of the run, as it is on the disk."""

    path: Path
    stated: str
    """The outcome stated when it ended."""
    outcome: str
    """The outcome on the disk."""
    whole: bool
    """Whether it is written to its end, though messages may be missing."""
    lost: Mapping[str, int] = attrs.field(factory=dict)
    """Topic -> messages that were not recorded."""
    size: str = ""
    """Its length and number of messages; empty if it cannot be read."""
    error: str = ""
    """Why it cannot be read."""

    @property
    def unknown(self) -> bool:
        """Whether its outcome is unknown although one was stated."""
        return self.whole and self.outcome == "unknown" != self.stated

    def line(self) -> str:
        """One line for the log."""
        if not self.whole:
            return f"{self.path}: unfinished{f': {self.size or self.error}' if self.size or self.error else ''}"
        parts = [self.outcome, *([self.size] if self.size else [])]
        if self.lost:
            parts.append(lost_text(self.lost))
        if self.unknown:
            parts.append(f"its end was lost, so nobody knows whether it ended as a {self.stated}")
        return f"{self.path.name}: {', '.join(parts)}"


def read_back(run: RunView, path: Path, stated: str, told: str, lost: Mapping[str, int]) -> WrittenEpisode:
    """What is on the disk of an episode that the recorder has ended without an error.

    Args:
        run: the run.
        path: the episode's folder.
        stated: the outcome stated when it ended.
        told: the outcome given to the recorder.
        lost: topic -> lost messages; what counts for a format without a reader.
    """
    if not any(reader.reads(path) for reader in run.registry.readers):
        return WrittenEpisode(path, stated, told, whole=True, lost=lost)  # nobody but its recorder knows the format
    try:
        with closing(run.registry.open_episode(path)) as reader:
            summary = reader.summary()
    except (IbrobotError, OSError) as error:
        return WrittenEpisode(path, stated, "unknown", whole=False, lost=lost, error=error_text(error, "; "))
    dropped = {topic: each.dropped + each.missing for topic, each in summary.topics.items()}
    return WrittenEpisode(
        path, stated, summary.outcome, summary.finished, {t: n for t, n in dropped.items() if n}, _size(summary)
    )


def _size(summary: EpisodeSummary) -> str:
    count = sum(each.count for each in summary.topics.values())
    return f"{seconds(summary.end_ns - summary.start_ns):.1f} s, {counted(count, 'message')}"


def lost_text(lost: Mapping[str, int]) -> str:
    """The number of lost messages, by topic, most first."""
    count = sum(lost.values())
    each = ", ".join(f"{topic} {number}" for topic, number in Counter(lost).most_common())
    return f"{counted(count, 'message')} lost ({each})"


def rows(episodes: Sequence[WrittenEpisode]) -> list[tuple[str, str]]:
    """Rows for the summary of a run: what is unfinished, what was lost, and which outcomes are unknown for that."""
    faults = [("unfinished", str(each.path)) for each in episodes if not each.whole]
    if lost := _sum(each.lost for each in episodes):
        count = sum(bool(each.lost) for each in episodes)
        faults.append(("lost", f"{lost_text(lost)}, in {count} of {counted(len(episodes), 'episode')}"))
    if unknown := [each for each in episodes if each.unknown]:
        each = ", ".join(f"{each.path.name} (was {each.stated})" for each in unknown)
        faults.append(("unknown", f"the end was lost of {each}; `ibrobot episodes mark` sets the outcome"))
    return faults


def _sum(lost: Iterable[Mapping[str, int]]) -> Counter[str]:
    return sum(map(Counter, lost), Counter[str]())
