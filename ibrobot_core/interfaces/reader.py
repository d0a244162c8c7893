"""Episode readers: what gives the messages of an episode back, also of one that was never finished."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import attrs

from ibrobot_core.errors import RecorderError
from ibrobot_core.messages import Message


@attrs.frozen(eq=False)
class Recorded:
    """A message as it was recorded."""

    topic: str
    message: Message
    received_ns: int
    """When the recorder's side had it [ns]: what alignment counts as the time of receipt."""
    published_ns: int
    """When it was sent [ns]; equal to `received_ns` where the episode does not tell them apart."""


@attrs.frozen
class TopicSummary:
    """One topic of an episode."""

    type: str
    """ROS 2 message type."""
    count: int
    """Messages that can be read."""
    dropped: int = 0
    """Messages that the recorder says it lost."""
    missing: int = 0
    """Messages that the recorder wrote and that cannot be read any more."""


@attrs.frozen
class EpisodeSummary:
    """What is known of an episode without decoding its messages."""

    path: Path
    finished: bool
    """False where its writer was killed; what can be read is counted all the same."""
    start_ns: int
    end_ns: int
    """Receipt of the first and the last message [ns]; both 0 for an episode without messages."""
    topics: Mapping[str, TopicSummary]
    metadata: Mapping[str, str]
    """What the recorder was given: prompt, contract, fingerprint, calibration, versions; empty in foreign bags."""
    outcome: str = "unknown"
    """`unknown` where the episode is unfinished or lacks messages, whatever was stated: its end may be missing."""
    stated_outcome: str = "unknown"
    """What the recorder stated at the end."""


@attrs.frozen
class EpisodeAddress:
    """Which episode is meant."""

    path: Path
    number: int | None = None
    """From 0, in a dataset of many; None where none is said."""
    given: Mapping[str, str] = attrs.field(factory=dict)
    """What the metadata of an episode is that has none, by the recorder's names: `contract`, `config`, `calibration`;
    and `norm_mode`, the unit of its joints."""

    @classmethod
    def of(cls, path: Path, given: Mapping[str, str] | None = None) -> EpisodeAddress:
        """The address of what a user calls `path`: an episode, or `DATASET:N`.

        Raises:
            RecorderError: when nothing is there.
        """
        named = re.fullmatch(r"(.+):(\d+)", path.name)
        if path.exists():
            return cls(path, None, given or {})
        if named is None or not (dataset := path.with_name(named[1])).exists():
            raise RecorderError(f"{path}: there is no such episode")
        return cls(dataset, int(named[2]), given or {})


class EpisodeReader(ABC):
    """Reads one episode. Messages come one by one: an episode need not fit into memory."""

    @abstractmethod
    def summary(self) -> EpisodeSummary:
        """What is in the episode.

        Raises:
            RecorderError: when it cannot be read.
        """

    @abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        """The messages of these topics (of all when None), in the order of receipt. May be called again.

        A message of a type that core does not know comes as a `messages.Message` made from its definition where the
        episode brings one.

        Raises:
            RecorderError: for damage in the midst of the file; what came before has been given.
        """

    @abstractmethod
    def digest(self) -> str:
        """A hash of all messages as they are stored, with topics and stamps: copies have equal ones.

        Raises:
            RecorderError: when they cannot be read.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the files. Safe to call twice."""
