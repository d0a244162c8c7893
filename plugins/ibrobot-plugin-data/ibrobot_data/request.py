"""The request for a conversion, and its report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import Contract, documented, option
from ibrobot_core.app import NORM_MODES
from ibrobot_data.conversion import MISSING, ONLY, OUTCOMES


@documented
@attrs.frozen
class ConversionRequest:
    """One conversion. Equal requests over equal episodes give equal bytes, whatever the number of jobs."""

    out: Path
    """The dataset's folder."""
    options: Any
    """Of the dataset writer."""
    type: str
    """Of the dataset writer."""
    contract: Contract | None = None
    """Replaces the recorded ones; episodes that ibrobot did not record need it."""
    document: Mapping[str, Any] | None = None
    """The robot YAML of `contract`, as plain values."""
    force_contract: bool = False
    """Whether `contract` may differ from the recorded ones."""
    calibration: Mapping[str, Mapping[str, Any]] | None = None
    """Joint -> fields of `JointCalibration`; replaces the recorded ones."""
    norm_mode: str = option("radians", choices=NORM_MODES)
    units: str | None = None
    """Type of what converts to `norm_mode`; None for the default."""
    missing: str = option("skip", choices=MISSING)
    """How to treat a tick with a missing observation: refuse the episode, skip the tick, or hold the last value."""
    outcomes: tuple[str, ...] = tuple(OUTCOMES)
    """Episodes of other outcomes are passed over."""
    prompt: str = ""
    """Task of the episodes that were recorded without one."""
    success: bool = False
    """Whether to add `next.success`: true at the last row of a successful episode."""
    labels: bool = False
    """Whether to add `intervention`, `next.reward` and `next.done`."""
    only: str = option("all", choices=ONLY)
    """Which rows to keep, by who commanded. Each stretch of them is an episode of the dataset."""
    context: float = option(2.0, ge=0)
    """Time to keep before and after each intervention, for `only: interventions` [s]."""
    any_robot: bool = False
    """Whether episodes of robots of other names, types or calibrations are merged."""
    append: bool = False
    """Whether to add to a dataset in `out`."""
    jobs: int | None = option(1, ge=1)
    """Episodes converted in parallel, each in its own process; None for as many as the pool has room for."""
    on: str = ""
    """The pool; see `open_pool`."""


def _pairs(lists: Iterable[Iterable[int]]) -> tuple[tuple[int, int], ...]:
    """Pairs of a JSON list, as tuples."""
    return tuple((first, second) for first, second in lists)


@attrs.frozen
class EpisodeReport:
    """Result for one episode."""

    source: str
    """`DATASET/EPISODE`, or the folder's name."""
    frames: int = 0
    skipped: int = 0
    """Ticks left out because something was missing."""
    cuts: tuple[tuple[int, int], ...] = attrs.field(default=(), converter=_pairs)
    """Where ticks were left out: the number of the row that follows, from 0, and how many ticks."""
    stretches: tuple[tuple[int, int], ...] = attrs.field(default=(), converter=_pairs)
    """The episodes that it gives in the dataset: number of the first row, from 0, and number of rows."""
    held: int = 0
    """Ticks with a missing observation, at which its last value was held."""
    gaps: Mapping[str, int] = attrs.field(factory=dict)
    """Key -> how often it went missing."""
    resets: Mapping[str, int] = attrs.field(factory=dict)
    """Topic -> how often its stamps jumped."""
    lost: Mapping[str, int] = attrs.field(factory=dict)
    """Topic -> messages that the recorder lost by its own count."""
    missing: Mapping[str, int] = attrs.field(factory=dict)
    """Topic -> recorded messages that can no longer be read."""
    finished: bool = True
    """False if its recorder was killed or the file was cut off; the episode then has the readable part."""
    outcome: str = "unknown"
    prompt: str = ""
    start_ns: int = 0
    """Stamp of the episode's first message [ns]."""
    identity: str = ""
    """Hash that identifies the episode; see `identity`."""
    error: str = ""
    """Why it was left out; empty if it was not."""
    passed_over: str = ""
    """Why it was not converted; empty if it was."""

    @property
    def kept(self) -> bool:
        """Whether it goes into the dataset."""
        return not self.error and not self.passed_over


@attrs.frozen
class Report:
    """Result of a conversion."""

    out: Path
    episodes: tuple[EpisodeReport, ...]
    """Reports in the order of the request."""
    size_bytes: int
    """Size of the whole dataset; 0 if there is none."""
    seconds: float
    resumed: int
    """Episodes that an earlier, interrupted run had converted."""

    @property
    def converted(self) -> tuple[EpisodeReport, ...]:
        """The episodes added to the dataset."""
        return tuple(each for each in self.episodes if each.kept)

    @property
    def failed(self) -> tuple[EpisodeReport, ...]:
        """The episodes left out because of an error."""
        return tuple(each for each in self.episodes if each.error)

    def summary(self) -> dict[str, Any]:
        """JSON values of the whole: the fields of the event of the same name."""
        done = self.converted
        episodes = sum(len(each.stretches) or 1 for each in done)
        return {
            "out": str(self.out), "episodes": episodes, "frames": sum(each.frames for each in done),
            "failed": len(self.failed), "passed_over": len(self.episodes) - len(done) - len(self.failed),
            "resumed": self.resumed, "skipped_ticks": sum(each.skipped for each in done),
            "held_ticks": sum(each.held for each in done), "gaps": sum(sum(each.gaps.values()) for each in done),
            "lost_messages": sum(sum(each.lost.values()) for each in done),
            "resets": sum(sum(each.resets.values()) for each in done),
            "without_prompt": sum(not each.prompt for each in done),
            "size_bytes": self.size_bytes, "seconds": round(self.seconds, 3),
        }  # fmt: skip
